//! A proxy between a service and its store that can fail, hang, or cut what passes.

use std::io::{Read, Write};
use std::net::{Ipv4Addr, Shutdown, TcpListener, TcpStream};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

/// What happens to requests.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Mode {
    /// They pass.
    Pass,
    /// They are answered with status 500.
    Fail,
    /// They are taken and not answered.
    Hang,
    /// Connections are cut.
    Cut,
}

struct Shared {
    mode: Mode,
    open: Vec<TcpStream>,
}

/// A running proxy; it ends with the test process.
pub struct Proxy {
    port: u16,
    shared: Arc<Mutex<Shared>>,
}

impl Proxy {
    /// Starts a proxy before a port of this machine.
    ///
    /// # Errors
    /// If no port can be listened on.
    pub fn start(to: u16) -> std::io::Result<Self> {
        Self::start_at(Ipv4Addr::LOCALHOST, to)
    }

    /// Starts a proxy that listens on an address of this machine.
    ///
    /// # Errors
    /// If no port can be listened on.
    pub fn start_at(address: Ipv4Addr, to: u16) -> std::io::Result<Self> {
        let listener = TcpListener::bind((address, 0))?;
        let port = listener.local_addr()?.port();
        let shared = Arc::new(Mutex::new(Shared {
            mode: Mode::Pass,
            open: Vec::new(),
        }));
        std::thread::spawn({
            let shared = shared.clone();
            move || {
                for client in listener.incoming().flatten() {
                    let shared = shared.clone();
                    std::thread::spawn(move || serve(client, to, &shared));
                }
            }
        });
        Ok(Self { port, shared })
    }

    /// Its port on this machine.
    #[must_use]
    pub fn port(&self) -> u16 {
        self.port
    }

    /// Changes what happens, and cuts what is on its way.
    pub fn set(&self, mode: Mode) {
        let mut shared = self.shared.lock().unwrap_or_else(PoisonError::into_inner);
        shared.mode = mode;
        for stream in shared.open.drain(..) {
            let _ = stream.shutdown(Shutdown::Both);
        }
    }
}

fn serve(mut client: TcpStream, to: u16, shared: &Mutex<Shared>) {
    let mode = {
        let mut shared = shared.lock().unwrap_or_else(PoisonError::into_inner);
        shared.open.retain(|stream| stream.peer_addr().is_ok());
        if let Ok(handle) = client.try_clone() {
            shared.open.push(handle);
        }
        shared.mode
    };
    match mode {
        Mode::Pass => {
            let Ok(server) = TcpStream::connect(("127.0.0.1", to)) else {
                return;
            };
            let (Ok(mut from_server), Ok(mut to_client)) = (server.try_clone(), client.try_clone()) else {
                return;
            };
            std::thread::spawn(move || {
                let _ = std::io::copy(&mut from_server, &mut to_client);
                let _ = to_client.shutdown(Shutdown::Both);
            });
            let mut to_server = server;
            let _ = std::io::copy(&mut client, &mut to_server);
            let _ = to_server.shutdown(Shutdown::Both);
        }
        Mode::Fail => {
            let _ = client.set_read_timeout(Some(Duration::from_secs(1)));
            let mut head = [0; 1024];
            let _ = client.read(&mut head);
            let _ = client.write_all(
                b"HTTP/1.1 500 Internal Server Error\r\nContent-Length: 0\r\nConnection: close\r\n\r\n",
            );
        }
        Mode::Hang => {
            // Until the mode changes, which shuts this connection.
            let mut rest = [0; 1024];
            while client.read(&mut rest).is_ok_and(|read| read > 0) {}
        }
        Mode::Cut => {
            let _ = client.shutdown(Shutdown::Both);
        }
    }
}
