//! The worker: begin, simulate, put, commit
