//! What is chosen: faults, whom they meet, and on which engine and store.

use std::time::Duration;

/// Seeded choices: splitmix64.
pub(super) struct Choices(pub(super) u64);

impl Choices {
    pub(super) fn next(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        z ^ (z >> 31)
    }

    pub(super) fn below(&mut self, end: usize) -> usize {
        usize::try_from(self.next() % end as u64).unwrap()
    }

    pub(super) fn of<'a, T>(&mut self, some: &'a [T]) -> &'a T {
        &some[self.below(some.len())]
    }

    pub(super) fn between(&mut self, least_ms: usize, most_ms: usize) -> Duration {
        Duration::from_millis((least_ms + self.below(most_ms - least_ms)) as u64)
    }
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(super) enum Fault {
    KillWorker,
    StopWorker,
    KillCoordinator,
    StopCoordinator,
    CrashPoint,
    KillPostgres,
    StoreFails,
    StoreHangs,
    StoreCutOff,
    DiskFull,
    NetworkCut,
    ClockJump,
}

impl Fault {
    pub(super) fn name(self) -> &'static str {
        match self {
            Self::KillWorker => "kill -9 of a worker",
            Self::StopWorker => "worker stopped, later continued",
            Self::KillCoordinator => "kill -9 of a coordinator",
            Self::StopCoordinator => "coordinator stopped, later continued",
            Self::CrashPoint => "death at begin, put, commit or publishing",
            Self::KillPostgres => "kill -9 of PostgreSQL",
            Self::StoreFails => "S3 answers 500",
            Self::StoreHangs => "S3 does not answer",
            Self::StoreCutOff => "S3 connections cut",
            Self::DiskFull => "disk full",
            Self::NetworkCut => "machine cut off the network, later joined again",
            Self::ClockJump => "wall clock of a process jumps by up to a day",
        }
    }
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(super) enum Setup {
    SqliteDirectory,
    SqliteS3,
    PostgresDirectory,
    PostgresS3,
}

impl Setup {
    pub(super) const ALL: [Self; 4] = [
        Self::SqliteDirectory,
        Self::PostgresS3,
        Self::SqliteS3,
        Self::PostgresDirectory,
    ];

    pub(super) fn name(self) -> &'static str {
        match self {
            Self::SqliteDirectory => "SQLite, directory",
            Self::SqliteS3 => "SQLite, S3",
            Self::PostgresDirectory => "PostgreSQL, directory",
            Self::PostgresS3 => "PostgreSQL, S3",
        }
    }

    pub(super) fn has_postgres(self) -> bool {
        matches!(self, Self::PostgresDirectory | Self::PostgresS3)
    }

    pub(super) fn has_s3(self) -> bool {
        matches!(self, Self::SqliteS3 | Self::PostgresS3)
    }
}
