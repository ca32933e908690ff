//! Names that point at models: `boom@stable`. A move is one inserted row.

use crate::engine::{Row, values};
use crate::{Ledger, LedgerError, clock};
use hydroflex_openapi::catalogue::AliasInfo;
use hydroflex_openapi::id::{AliasName, ModelId};

/// One move of an alias.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct AliasRecord {
    /// Its name.
    pub alias: AliasName,
    /// Counts from 1.
    pub generation: u64,
    /// Where it points.
    pub model_id: ModelId,
    /// Since when, ms since 1970.
    pub moved_ms: i64,
}

impl AliasRecord {
    fn read(row: &Row) -> Result<Self, LedgerError> {
        Ok(Self {
            alias: row.parse("alias")?,
            generation: row.count("generation")?,
            model_id: row.parse("model_id")?,
            moved_ms: row.int("moved_ms")?,
        })
    }

    /// As the contract shows it.
    #[must_use]
    pub fn info(&self) -> AliasInfo {
        AliasInfo {
            alias: self.alias.clone(),
            model_id: self.model_id.clone(),
            generation: self.generation,
            moved_at: clock::rfc3339(self.moved_ms),
        }
    }
}

/// What has to hold for an alias to be moved.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum AliasCondition {
    /// Nothing.
    None,
    /// It does not exist yet.
    Absent,
    /// It exists.
    Present,
    /// It is at this generation.
    Generation(u64),
}

/// What became of a move.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum AliasMove {
    /// It points at the model from now on.
    Moved(AliasRecord),
    /// It pointed there already: nothing was written.
    Unchanged(AliasRecord),
    /// The condition does not hold; the alias as it is, if it exists.
    Refused(Option<AliasRecord>),
}

impl Ledger {
    /// Points an alias at a registered model, if the condition holds.
    ///
    /// # Errors
    /// Passes on what the database says.
    pub async fn move_alias(
        &self,
        alias: &AliasName,
        model: &ModelId,
        condition: AliasCondition,
    ) -> Result<AliasMove, LedgerError> {
        let mut tx = self.pool.begin().await?;
        let now = tx
            .row(
                "SELECT * FROM aliases WHERE alias = $1 ORDER BY generation DESC LIMIT 1",
                values![alias.as_str()],
            )
            .await?
            .as_ref()
            .map(AliasRecord::read)
            .transpose()?;
        let generation = now.as_ref().map(|record| record.generation);
        let holds = match condition {
            AliasCondition::None => true,
            AliasCondition::Absent => generation.is_none(),
            AliasCondition::Present => generation.is_some(),
            AliasCondition::Generation(expected) => generation == Some(expected),
        };
        if !holds {
            return Ok(AliasMove::Refused(now));
        }
        if let Some(record) = now.filter(|record| record.model_id == *model) {
            return Ok(AliasMove::Unchanged(record));
        }
        let record = AliasRecord {
            alias: alias.clone(),
            generation: generation.unwrap_or(0) + 1,
            model_id: model.clone(),
            moved_ms: clock::now_ms(),
        };
        // Two movers on PostgreSQL may both have read the same generation: the key lets one through.
        let inserted = tx
            .execute(
                "INSERT INTO aliases (alias, generation, model_id, moved_ms) VALUES ($1, $2, $3, $4) \
                 ON CONFLICT (alias, generation) DO NOTHING",
                values![alias.as_str(), record.generation, model.as_str(), record.moved_ms],
            )
            .await?;
        tx.commit().await?;
        if inserted == 0 {
            return Ok(AliasMove::Refused(self.alias(alias).await?));
        }
        Ok(AliasMove::Moved(record))
    }

    /// Where an alias points now.
    ///
    /// # Errors
    /// Passes on what the database says.
    pub async fn alias(&self, alias: &AliasName) -> Result<Option<AliasRecord>, LedgerError> {
        Ok(self.alias_history(alias).await?.pop())
    }

    /// Every model that an alias has pointed at, oldest first.
    ///
    /// # Errors
    /// Passes on what the database says.
    pub async fn alias_history(&self, alias: &AliasName) -> Result<Vec<AliasRecord>, LedgerError> {
        self.pool
            .rows(
                "SELECT * FROM aliases WHERE alias = $1 ORDER BY generation",
                values![alias.as_str()],
            )
            .await?
            .iter()
            .map(AliasRecord::read)
            .collect()
    }

    /// Every alias as it is now, by name.
    ///
    /// # Errors
    /// Passes on what the database says.
    pub async fn aliases(&self) -> Result<Vec<AliasRecord>, LedgerError> {
        self.pool
            .rows(
                "SELECT * FROM aliases AS a WHERE generation = \
                 (SELECT MAX(generation) FROM aliases AS b WHERE b.alias = a.alias) ORDER BY alias",
                &[],
            )
            .await?
            .iter()
            .map(AliasRecord::read)
            .collect()
    }
}
