//! API keys: made once, shown once, kept as hashes.

use crate::engine::{Row, values};
use crate::{Ledger, LedgerError, clock};
use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};
use std::fmt;
use std::str::FromStr;
use uuid::Uuid;

/// Every key begins with this, so that scanners for leaked secrets can find it.
const PREFIX: &str = "hfx_";

/// What a key opens.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Scope {
    /// Submit, change and cancel jobs and trainings.
    Submit,
    /// Look at everything and download it.
    Read,
    /// Ask models for estimates.
    Predict,
    /// Everything.
    Admin,
}

impl Scope {
    /// Every scope.
    pub const ALL: [Self; 4] = [Self::Submit, Self::Read, Self::Predict, Self::Admin];

    /// As written on the command line.
    #[must_use]
    pub fn as_str(self) -> &'static str {
        match self {
            Self::Submit => "submit",
            Self::Read => "read",
            Self::Predict => "predict",
            Self::Admin => "admin",
        }
    }
}

impl fmt::Display for Scope {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.as_str())
    }
}

/// A word that names no scope.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("{0:?} is no scope; allowed: submit, read, predict, admin")]
pub struct UnknownScope(pub String);

impl FromStr for Scope {
    type Err = UnknownScope;
    fn from_str(text: &str) -> Result<Self, UnknownScope> {
        Self::ALL
            .into_iter()
            .find(|scope| scope.as_str() == text)
            .ok_or_else(|| UnknownScope(text.to_owned()))
    }
}

/// A key as the ledger knows it: not the key itself.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct KeyRecord {
    /// Identifier, for people.
    pub id: Uuid,
    /// What it is for, in its maker's words.
    pub title: String,
    /// What it opens.
    pub scopes: Vec<Scope>,
    /// When it was made, ms since 1970.
    pub created_ms: i64,
    /// When it ends.
    pub expires_ms: Option<i64>,
    /// When it was revoked.
    pub revoked_ms: Option<i64>,
}

impl KeyRecord {
    fn read(row: &Row) -> Result<Self, LedgerError> {
        Ok(Self {
            id: row.parse("id")?,
            title: row.text("title")?,
            scopes: row.json("scopes")?,
            created_ms: row.int("created_ms")?,
            expires_ms: row.optional_int("expires_ms")?,
            revoked_ms: row.optional_int("revoked_ms")?,
        })
    }

    /// Why the key opens nothing at a time, if so.
    #[must_use]
    pub fn ended(&self, now_ms: i64) -> Option<&'static str> {
        if self.revoked_ms.is_some() {
            Some("revoked")
        } else if self.expires_ms.is_some_and(|expires| now_ms >= expires) {
            Some("expired")
        } else {
            None
        }
    }

    /// Whether it opens what needs `scope`.
    #[must_use]
    pub fn opens(&self, scope: Scope) -> bool {
        self.scopes
            .iter()
            .any(|own| *own == scope || *own == Scope::Admin)
    }
}

/// SHA-256 of a key as it is kept. A key has 256 random bits: a slow hash would add nothing.
#[must_use]
pub fn hash(key: &str) -> String {
    hex::encode(Sha256::digest(key))
}

impl Ledger {
    /// Makes a key; returned once, never again.
    ///
    /// # Errors
    /// If the system has no random numbers; what the database says.
    pub async fn create_key(
        &self,
        title: &str,
        scopes: &[Scope],
        expires_ms: Option<i64>,
    ) -> Result<(String, KeyRecord), LedgerError> {
        let mut bits = [0_u8; 32];
        getrandom::fill(&mut bits).map_err(|error| LedgerError::Random(error.to_string()))?;
        let key = format!("{PREFIX}{}", hex::encode(bits));
        let record = KeyRecord {
            id: Uuid::now_v7(),
            title: title.to_owned(),
            scopes: scopes.to_vec(),
            created_ms: clock::now_ms(),
            expires_ms,
            revoked_ms: None,
        };
        self.pool
            .execute(
                "INSERT INTO api_keys (id, title, sha256, scopes, created_ms, expires_ms) \
                 VALUES ($1, $2, $3, $4, $5, $6)",
                values![
                    record.id.to_string(),
                    title,
                    hash(&key),
                    serde_json::to_string(scopes)?,
                    record.created_ms,
                    expires_ms,
                ],
            )
            .await?;
        Ok((key, record))
    }

    /// The key with this hash, whether it still opens anything or not.
    ///
    /// # Errors
    /// Passes on what the database says.
    pub async fn key(&self, sha256: &str) -> Result<Option<KeyRecord>, LedgerError> {
        self.pool
            .row("SELECT * FROM api_keys WHERE sha256 = $1", values![sha256])
            .await?
            .as_ref()
            .map(KeyRecord::read)
            .transpose()
    }

    /// Every key, oldest first.
    ///
    /// # Errors
    /// Passes on what the database says.
    pub async fn keys(&self) -> Result<Vec<KeyRecord>, LedgerError> {
        self.pool
            .rows("SELECT * FROM api_keys ORDER BY id", &[])
            .await?
            .iter()
            .map(KeyRecord::read)
            .collect()
    }

    /// Revokes a key. False if there is none, or it was revoked before.
    ///
    /// # Errors
    /// Passes on what the database says.
    pub async fn revoke_key(&self, id: Uuid) -> Result<bool, LedgerError> {
        let changed = self
            .pool
            .execute(
                "UPDATE api_keys SET revoked_ms = $2 WHERE id = $1 AND revoked_ms IS NULL",
                values![id.to_string(), clock::now_ms()],
            )
            .await?;
        Ok(changed == 1)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_key_opens_what_its_scopes_say_until_it_ends() {
        let key = KeyRecord {
            id: Uuid::now_v7(),
            title: String::new(),
            scopes: vec![Scope::Read],
            created_ms: 0,
            expires_ms: Some(100),
            revoked_ms: None,
        };
        assert!(key.opens(Scope::Read) && !key.opens(Scope::Submit));
        assert_eq!(key.ended(99), None);
        assert_eq!(key.ended(100), Some("expired"));
        let admin = KeyRecord {
            scopes: vec![Scope::Admin],
            expires_ms: None,
            ..key.clone()
        };
        assert!(Scope::ALL.into_iter().all(|scope| admin.opens(scope)));
        assert_eq!(admin.ended(i64::MAX), None);
        let revoked = KeyRecord {
            revoked_ms: Some(5),
            ..admin
        };
        assert_eq!(revoked.ended(6), Some("revoked"));
    }
}
