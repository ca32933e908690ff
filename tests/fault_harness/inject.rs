//! How each fault is done to a trial.

use crate::fault::Fault;
use crate::trial::{Servers, Trial};
use anyhow::Context;
use hydroflex_tests::proxy::Mode;
use hydroflex_tests::{Pilot, signal};
use nix::sys::signal::Signal;
use std::time::{Duration, Instant};

impl Trial {
    pub(super) fn allowed(&self) -> Vec<Fault> {
        use Fault::{
            ClockJump, CrashPoint, DiskFull, KillCoordinator, KillPostgres, KillWorker, NetworkCut,
            StopCoordinator, StopWorker, StoreCutOff, StoreFails, StoreHangs,
        };
        let mut faults = vec![
            KillWorker,
            KillWorker,
            StopWorker,
            KillCoordinator,
            StopCoordinator,
            CrashPoint,
            CrashPoint,
        ];
        if self.setup.has_postgres() {
            faults.push(KillPostgres);
        }
        if self.setup.has_s3() {
            faults.extend([StoreFails, StoreHangs, StoreCutOff]);
        }
        if self.disk.is_some() {
            faults.push(DiskFull);
        }
        if self.network.is_some() {
            faults.extend([NetworkCut, NetworkCut]);
        }
        if self.clock_library.is_some() {
            faults.push(ClockJump);
        }
        faults
    }

    /// Injects a fault. False if there was nothing to do it to.
    pub(super) fn inject(&mut self, fault: Fault, servers: &Servers) -> anyhow::Result<bool> {
        let happened = match fault {
            Fault::KillWorker => match self.some_worker() {
                Some(worker) => signal(worker, Signal::SIGKILL).is_ok(),
                None => false,
            },
            Fault::StopWorker => match self.some_worker() {
                Some(worker) => self.stop_for(worker, 200, 6000),
                None => false,
            },
            Fault::KillCoordinator | Fault::StopCoordinator => {
                let index = self.choices.below(self.coordinators.len());
                match &self.coordinators[index] {
                    Some(service) if fault == Fault::StopCoordinator => {
                        let process = service.pid();
                        self.stop_for(process, 200, 5000)
                    }
                    Some(service) => {
                        let process = service.pid();
                        self.armed[index] = false;
                        signal(process, Signal::SIGKILL).is_ok()
                    }
                    None => false,
                }
            }
            Fault::CrashPoint => self.arm_a_crash_point()?,
            Fault::KillPostgres => {
                let pause = self.choices.between(0, 1500);
                servers
                    .postgres
                    .as_ref()
                    .context("only chosen where PostgreSQL runs")?
                    .kill_and_restart(pause);
                true
            }
            Fault::StoreFails | Fault::StoreHangs | Fault::StoreCutOff => {
                let pause = self.choices.between(100, 2500);
                let proxy = self.proxy.as_ref().context("only chosen where S3 is used")?;
                proxy.set(match fault {
                    Fault::StoreFails => Mode::Fail,
                    Fault::StoreHangs => Mode::Hang,
                    _ => Mode::Cut,
                });
                std::thread::sleep(pause);
                proxy.set(Mode::Pass);
                true
            }
            Fault::DiskFull => {
                let pause = self.choices.between(200, 2500);
                let disk = self.disk.as_ref().context("only chosen where there is one")?;
                disk.fill();
                std::thread::sleep(pause);
                disk.empty();
                true
            }
            Fault::NetworkCut => {
                let pause = self.choices.between(500, 9000);
                let network = self.network.as_ref().context("only chosen where there is one")?;
                let machine = self.choices.below(network.machines());
                let is_cut = self.cut.iter().any(|(cut, _)| *cut == machine);
                let happened = !is_cut && network.cut(machine);
                if happened {
                    self.cut.push((machine, Instant::now() + pause));
                }
                happened
            }
            Fault::ClockJump => {
                let clock = self.choices.of(&self.clocks);
                let minutes = i64::try_from(self.choices.below(2 * 24 * 60))? - 24 * 60;
                clock.set_ahead(60 * minutes)?;
                true
            }
        };
        if happened {
            *self.counts.entry(fault).or_default() += 1;
        }
        Ok(happened)
    }

    pub(super) fn some_worker(&mut self) -> Option<u32> {
        let mut workers: Vec<u32> = self.pilots.iter().map(Pilot::pid).collect();
        for service in self.coordinators.iter().flatten() {
            workers.extend(service.children("simulate"));
        }
        workers.retain(|worker| !self.stopped.iter().any(|(stopped, _)| stopped == worker));
        (!workers.is_empty()).then(|| *self.choices.of(&workers))
    }

    pub(super) fn stop_for(&mut self, process: u32, least_ms: usize, most_ms: usize) -> bool {
        let pause = self.choices.between(least_ms, most_ms);
        if self.stopped.iter().any(|(stopped, _)| *stopped == process)
            || signal(process, Signal::SIGSTOP).is_err()
        {
            return false;
        }
        self.stopped.push((process, Instant::now() + pause));
        true
    }

    /// Lets a process die by itself at a chosen place: counted when the process is gone.
    pub(super) fn arm_a_crash_point(&mut self) -> anyhow::Result<bool> {
        let points = [
            "begin",
            "put",
            "commit",
            "publish-written",
            "publish-upload",
            "publish-commit",
            "published",
        ];
        let point = *self.choices.of(&points);
        if point.starts_with("publish") {
            let index = self.choices.below(self.coordinators.len());
            self.coordinators[index] = None;
            self.coordinators[index] = self.start_coordinator(index, Some(point)).ok();
            // Killing it to give it its orders is a fault of its own; its death will be another.
            self.armed[index] = self.coordinators[index].is_some();
            *self.counts.entry(Fault::KillCoordinator).or_default() += 1;
            return Ok(false);
        }
        let times = 1 + self.choices.below(3);
        let mut pilot = self.start_pilot(0, Some(format!("{point}:{times}")))?;
        let start = Instant::now();
        while pilot.is_running() {
            // Nothing left to do for it: then it does not die, and is no fault.
            if start.elapsed() > Duration::from_secs(5) {
                return Ok(false);
            }
            std::thread::sleep(Duration::from_millis(10));
        }
        Ok(true)
    }
}
