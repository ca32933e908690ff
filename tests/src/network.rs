//! Machines that are not there: network namespaces behind a bridge, whose cables can be pulled. Only root
//! can make them; where they cannot be made, what needs them is left out with a note.

use nix::sched::{CloneFlags, setns};
use std::fs::File;
use std::io;
use std::net::{Ipv4Addr, Shutdown, TcpListener, TcpStream};
use std::process::{Command, Stdio};
use std::sync::atomic::{AtomicU32, Ordering};

/// A bridge with an address of this machine, and namespaces with a cable to it each.
pub struct Network {
    tag: String,
    subnet: u8,
    machines: usize,
}

impl Network {
    /// Makes a network of that many machines; `None` where that cannot be done.
    #[must_use]
    pub fn new(machines: usize) -> Option<Self> {
        static NUMBER: AtomicU32 = AtomicU32::new(0);
        let number = NUMBER.fetch_add(1, Ordering::Relaxed);
        // Names of devices have fifteen characters at most.
        let tag = format!("hf{}-{number}", std::process::id() % 10_000);
        let subnet = u8::try_from((std::process::id() + number) % 250).ok()?;
        let network = Self {
            tag,
            subnet,
            machines,
        };
        let bridge = network.bridge();
        let here = format!("{}/24", network.here());
        let mut made = ip(&["link", "add", &bridge, "type", "bridge"])
            && ip(&["addr", "add", &here, "dev", &bridge])
            && ip(&["link", "set", &bridge, "up"]);
        for machine in 0..machines {
            let (name, cable, plug) = (
                network.name(machine),
                network.cable(machine),
                network.plug(machine),
            );
            let address = format!("10.213.{}.{}/24", network.subnet, machine + 10);
            made = made
                && ip(&["netns", "add", &name])
                && ip(&["link", "add", &cable, "type", "veth", "peer", "name", &plug])
                && ip(&["link", "set", &plug, "netns", &name])
                && ip(&["link", "set", &cable, "master", &bridge])
                && ip(&["link", "set", &cable, "up"])
                && ip(&["-n", &name, "addr", "add", &address, "dev", &plug])
                && ip(&["-n", &name, "link", "set", &plug, "up"])
                && ip(&["-n", &name, "link", "set", "lo", "up"]);
        }
        if !made {
            eprintln!("network namespaces cannot be made here: what needs them is left out");
        }
        made.then_some(network)
    }

    /// Number of machines.
    #[must_use]
    pub fn machines(&self) -> usize {
        self.machines
    }

    /// Address under which the machines reach this one.
    #[must_use]
    pub fn here(&self) -> Ipv4Addr {
        Ipv4Addr::new(10, 213, self.subnet, 1)
    }

    /// Namespace of a machine.
    #[must_use]
    pub fn name(&self, machine: usize) -> String {
        format!("{}-{machine}", self.tag)
    }

    /// Pulls the cable: what is on its way is lost, and nobody is told.
    #[must_use]
    pub fn cut(&self, machine: usize) -> bool {
        ip(&["link", "set", &self.cable(machine), "down"])
    }

    /// Puts the cable back.
    #[must_use]
    pub fn mend(&self, machine: usize) -> bool {
        ip(&["link", "set", &self.cable(machine), "up"])
    }

    fn bridge(&self) -> String {
        format!("{}b", self.tag)
    }

    fn cable(&self, machine: usize) -> String {
        format!("{}c{machine}", self.tag)
    }

    fn plug(&self, machine: usize) -> String {
        format!("{}p{machine}", self.tag)
    }
}

impl Drop for Network {
    fn drop(&mut self) {
        for machine in 0..self.machines {
            ip(&["link", "delete", &self.cable(machine)]);
            ip(&["netns", "delete", &self.name(machine)]);
        }
        ip(&["link", "delete", &self.bridge()]);
    }
}

fn ip(arguments: &[&str]) -> bool {
    Command::new("ip")
        .args(arguments)
        .stdout(Stdio::null())
        .stderr(Stdio::null())
        .status()
        .is_ok_and(|status| status.success())
}

/// Listens on an address of this machine and passes connections on to a loopback port: of this machine, or
/// of a namespace. Returns the port. It ends with the test process.
///
/// # Errors
/// If nothing can be listened on.
pub fn forward(from: Ipv4Addr, to: u16, namespace: Option<String>) -> io::Result<u16> {
    let listener = TcpListener::bind((from, 0))?;
    let port = listener.local_addr()?.port();
    std::thread::spawn(move || {
        // A socket belongs to the namespace it was made in: this thread listens here and connects there.
        if let Some(name) = &namespace
            && enter(name).is_err()
        {
            return;
        }
        for client in listener.incoming().flatten() {
            let Ok(server) = TcpStream::connect((Ipv4Addr::LOCALHOST, to)) else {
                continue;
            };
            let (Ok(client_too), Ok(server_too)) = (client.try_clone(), server.try_clone()) else {
                continue;
            };
            std::thread::spawn(move || pass(client, server));
            std::thread::spawn(move || pass(server_too, client_too));
        }
    });
    Ok(port)
}

fn pass(mut from: TcpStream, mut to: TcpStream) {
    let _ = io::copy(&mut from, &mut to);
    let _ = to.shutdown(Shutdown::Write);
}

fn enter(namespace: &str) -> io::Result<()> {
    let file = File::open(format!("/run/netns/{namespace}"))?;
    setns(file, CloneFlags::CLONE_NEWNET).map_err(io::Error::from)
}
