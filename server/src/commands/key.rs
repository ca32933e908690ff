//! `hydroflex key`: API keys, made and revoked beside the database.

use anyhow::{Context, bail};
use hydroflex_ledger::keys::{KeyRecord, Scope};
use hydroflex_ledger::{Ledger, clock};
use std::path::PathBuf;

/// Which ledger.
#[derive(Debug, Clone, clap::Args)]
pub struct LedgerArgs {
    /// Directory of the embedded database
    #[arg(long, default_value = "hydroflex-data", env = "HYDROFLEX_DATA")]
    pub data: PathBuf,
    /// Database URL (default: SQLite below --data)
    #[arg(long, env = "HYDROFLEX_DATABASE", hide_env_values = true)]
    pub database: Option<String>,
    /// Print machine-readable output
    #[arg(long)]
    pub json: bool,
}

/// Subcommands of `hydroflex key`.
#[derive(Debug, clap::Subcommand)]
pub enum Command {
    /// Make a key and print it: it is shown this once and never again
    Create {
        /// What it may do: submit, read, predict, admin (everything); comma-separated
        #[arg(long, value_delimiter = ',', required = true)]
        scopes: Vec<Scope>,
        /// What it is for
        #[arg(long, default_value = "")]
        title: String,
        /// Days until it ends (default: never)
        #[arg(long, value_parser = clap::value_parser!(u32).range(1..=36500))]
        days: Option<u32>,
        /// Ledger
        #[command(flatten)]
        ledger: LedgerArgs,
    },
    /// List keys, without what is secret about them
    List {
        /// Ledger
        #[command(flatten)]
        ledger: LedgerArgs,
    },
    /// Revoke a key; a running service believes so within five seconds
    Revoke {
        /// Id of the key, as `list` shows it
        key: uuid::Uuid,
        /// Ledger
        #[command(flatten)]
        ledger: LedgerArgs,
    },
}

/// Runs the command.
///
/// # Errors
/// If the database cannot be opened or written, or there is no such key.
pub fn run(command: Command) -> anyhow::Result<()> {
    tokio::runtime::Runtime::new()?.block_on(work(command))
}

async fn work(command: Command) -> anyhow::Result<()> {
    match command {
        Command::Create {
            mut scopes,
            title,
            days,
            ledger: args,
        } => {
            scopes.sort_unstable();
            scopes.dedup();
            let expires_ms = days.map(|days| clock::now_ms() + i64::from(days) * 86_400_000);
            let (key, record) = open(&args, true)
                .await?
                .create_key(&title, &scopes, expires_ms)
                .await?;
            if args.json {
                let mut shown = as_json(&record);
                shown["key"] = key.into();
                return super::print_json(&shown);
            }
            eprintln!("key {}; keep it, it is not shown again:", record.id);
            super::print_line(format_args!("{key}"))
        }
        Command::List { ledger: args } => {
            let keys = open(&args, false).await?.keys().await?;
            if args.json {
                return super::print_json(&keys.iter().map(as_json).collect::<Vec<_>>());
            }
            super::print_line(format_args!(
                "{:36}  {:22}  {:20}  title",
                "key", "scopes", "state"
            ))?;
            for key in keys {
                super::print_line(format_args!(
                    "{}  {:22}  {:20}  {}",
                    key.id,
                    scopes(&key),
                    state(&key),
                    key.title
                ))?;
            }
            Ok(())
        }
        Command::Revoke { key, ledger: args } => {
            if open(&args, false).await?.revoke_key(key).await? {
                super::print_line(format_args!("revoked {key}"))
            } else {
                bail!("no key {key}, or it was revoked before")
            }
        }
    }
}

/// A database that is not there yet is made for a new key only: keys may come before the first start of the service.
async fn open(args: &LedgerArgs, makes: bool) -> anyhow::Result<Ledger> {
    let url = if let Some(url) = &args.database {
        url.clone()
    } else {
        let file = args.data.join("ledger.sqlite");
        if !file.exists() {
            if !makes {
                bail!(
                    "no service has its data in {}; --data names its directory",
                    args.data.display()
                );
            }
            eprintln!(
                "note: there is no service's data in {} yet; the key is for one that is started with the same --data",
                args.data.display()
            );
        }
        std::fs::create_dir_all(&args.data).with_context(|| {
            format!(
                "cannot make {}; --data names the service's directory",
                args.data.display()
            )
        })?;
        format!("sqlite:{}", file.display())
    };
    Ledger::create(&url).await.context("cannot open the database")
}

fn scopes(key: &KeyRecord) -> String {
    key.scopes
        .iter()
        .map(|scope| scope.as_str())
        .collect::<Vec<_>>()
        .join(",")
}

fn state(key: &KeyRecord) -> String {
    match (key.ended(clock::now_ms()), key.expires_ms) {
        (Some(ended), _) => ended.to_owned(),
        (None, Some(expires_ms)) => format!("until {}", &clock::rfc3339(expires_ms)[..10]),
        (None, None) => "for ever".to_owned(),
    }
}

fn as_json(key: &KeyRecord) -> serde_json::Value {
    serde_json::json!({
        "id": key.id,
        "title": key.title,
        "scopes": key.scopes,
        "created_at": clock::rfc3339(key.created_ms),
        "expires_at": key.expires_ms.map(clock::rfc3339),
        "revoked_at": key.revoked_ms.map(clock::rfc3339),
    })
}
