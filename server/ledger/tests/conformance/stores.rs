//! Blobs: created once, read whole or in part, deleted below a key.

use crate::{HASH, sha256};
use bytes::Bytes;
use futures::TryStreamExt;
use hydroflex_ledger::blobs::{BlobError, Blobs};
use hydroflex_openapi::catalogue::FileEntry;

on_every_store![
    a_store_that_is_there_answers,
    an_object_is_created_once,
    of_many_creators_one_wins,
    a_part_of_an_object_is_streamed,
    a_damaged_or_missing_object_is_a_loss,
    a_large_file_is_uploaded_in_parts,
    a_folder_is_there_to_read_as_files,
    what_is_below_a_key_is_listed_and_deleted_and_nothing_else,
    a_put_that_was_interrupted_is_seen_by_nobody_and_deleted,
];

async fn a_store_that_is_there_answers(blobs: Blobs) {
    blobs.ping().await.unwrap();
    blobs
        .wait_until_there(std::time::Duration::from_secs(1))
        .await
        .unwrap();
}

async fn an_object_is_created_once(blobs: Blobs) {
    let first = Bytes::from_static(b"first");
    blobs.create("shards/j/a.parquet", first.clone()).await.unwrap();
    let second = blobs
        .create("shards/j/a.parquet", Bytes::from_static(b"second"))
        .await
        .unwrap_err();
    assert!(second.is_already_there() && !second.is_loss(), "{second}");
    let content = blobs.read("shards/j/a.parquet", &sha256(&first)).await.unwrap();
    assert_eq!(content, first);
    blobs.delete("shards/j/a.parquet").await.unwrap();
    blobs.delete("shards/j/a.parquet").await.unwrap();
    blobs.create("shards/j/a.parquet", first).await.unwrap();
}

async fn of_many_creators_one_wins(blobs: Blobs) {
    let creators = (0..8).map(|number| {
        let blobs = blobs.clone();
        tokio::spawn(async move {
            blobs
                .create("race", Bytes::from(format!("creator {number}")))
                .await
        })
    });
    let mut winners = 0;
    for creator in futures::future::join_all(creators).await {
        match creator.unwrap() {
            Ok(()) => winners += 1,
            Err(error) => assert!(error.is_already_there(), "{error}"),
        }
    }
    assert_eq!(winners, 1);
}

async fn a_part_of_an_object_is_streamed(blobs: Blobs) {
    let content: Vec<u8> = (0..=255).cycle().take(100_000).collect();
    blobs
        .create("object", Bytes::from(content.clone()))
        .await
        .unwrap();
    for range in [0..100_000, 0..1, 99_999..100_000, 12_345..54_321, 7..7] {
        let parts: Vec<Bytes> = blobs
            .stream("object", range.clone())
            .await
            .unwrap()
            .try_collect()
            .await
            .unwrap();
        let (start, end) = (range.start.try_into().unwrap(), range.end.try_into().unwrap());
        assert_eq!(parts.concat(), &content[start..end], "{range:?}");
    }
}

async fn a_damaged_or_missing_object_is_a_loss(blobs: Blobs) {
    blobs
        .create("object", Bytes::from_static(b"other"))
        .await
        .unwrap();
    let damaged = blobs.read("object", HASH).await.unwrap_err();
    assert!(
        matches!(damaged, BlobError::Damaged { .. }) && damaged.is_loss(),
        "{damaged}"
    );
    let missing = blobs.read("nothing", HASH).await.unwrap_err();
    assert!(missing.is_loss() && !missing.is_transient(), "{missing}");
}

async fn a_large_file_is_uploaded_in_parts(blobs: Blobs) {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("large");
    let content: Vec<u8> = (0..20_000_000_u32).map(|index| (index % 251) as u8).collect();
    std::fs::write(&file, &content).unwrap();
    // Twice: the same content under the same name.
    for _ in 0..2 {
        blobs
            .upload(&file, "datasets/d/data/large.parquet")
            .await
            .unwrap();
        let read = blobs
            .read("datasets/d/data/large.parquet", &sha256(&content))
            .await
            .unwrap();
        assert_eq!(read.len(), content.len());
    }
    let nothing = blobs
        .upload(&folder.path().join("absent"), "absent")
        .await
        .unwrap_err();
    assert!(matches!(nothing, BlobError::File { .. }), "{nothing}");
}

async fn a_folder_is_there_to_read_as_files(blobs: Blobs) {
    let content = Bytes::from_static(b"read me");
    blobs
        .create("datasets/d/README.md", content.clone())
        .await
        .unwrap();
    blobs
        .create("datasets/d/data/a.parquet", content.clone())
        .await
        .unwrap();
    let files: Vec<FileEntry> = ["README.md", "data/a.parquet"]
        .iter()
        .map(|path| FileEntry {
            path: (*path).to_owned(),
            size_bytes: content.len() as u64,
            sha256: sha256(&content),
        })
        .collect();
    let (path, _temporary) = blobs.folder("datasets/d/", &files).await.unwrap();
    for file in &files {
        assert_eq!(std::fs::read(path.join(&file.path)).unwrap(), content);
    }
}

async fn what_is_below_a_key_is_listed_and_deleted_and_nothing_else(blobs: Blobs) {
    for key in ["shards/j/a", "shards/j/b", "shards/jj/a", "datasets/j/a"] {
        blobs.create(key, Bytes::from_static(b"x")).await.unwrap();
    }
    assert_eq!(
        blobs.list("shards/j").await.unwrap(),
        ["shards/j/a", "shards/j/b"]
    );
    assert_eq!(blobs.list("nothing").await.unwrap(), Vec::<String>::new());
    assert_eq!(blobs.folders("shards").await.unwrap(), ["j", "jj"]);
    assert_eq!(blobs.folders("shards/j").await.unwrap(), Vec::<String>::new());
    assert_eq!(blobs.delete_below("shards/j").await.unwrap(), 2);
    assert_eq!(blobs.delete_below("shards/j").await.unwrap(), 0);
    assert_eq!(blobs.list("shards").await.unwrap(), ["shards/jj/a"]);
    assert_eq!(blobs.list("datasets").await.unwrap(), ["datasets/j/a"]);
}

async fn a_put_that_was_interrupted_is_seen_by_nobody_and_deleted(blobs: Blobs) {
    let Some(folder) = blobs.local_path("shards/k") else {
        // An object store shows an object whole or not at all.
        return;
    };
    let key = "shards/k/a.parquet";
    blobs.create(key, Bytes::from_static(b"whole")).await.unwrap();
    // What a process leaves that dies while it writes an object.
    std::fs::write(folder.join("b.parquet#1"), b"ha").unwrap();
    std::fs::write(folder.join("b.parquet#2"), b"half").unwrap();
    assert_eq!(blobs.list("shards/k").await.unwrap(), [key]);
    assert_eq!(blobs.delete_below("shards/k").await.unwrap(), 1);
    assert!(!folder.exists());
}
