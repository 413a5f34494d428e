//! Rewrites recordings as other programs write them: compressed, with chunks of any size.

use mcap::{Attachment, Compression, MessageStream, Summary, WriteOptions};
use std::io::Cursor;

/// Copies all messages and attachments of a recording to a new one with compressed chunks.
pub(crate) fn recompress(recording: &[u8], compression: Compression, chunk_bytes: u64) -> Vec<u8> {
    let options = WriteOptions::new()
        .compression(Some(compression))
        .chunk_size(Some(chunk_bytes));
    let mut writer = options.create(Cursor::new(Vec::new())).expect("memory");
    let summary = Summary::read(recording)
        .expect("a complete recording")
        .expect("recordings have a summary");
    for message in MessageStream::new(recording).expect("a recording") {
        writer
            .write(&message.expect("a complete recording"))
            .expect("memory");
    }
    // Newer versions of the `mcap` program write attachments last.
    for index in &summary.attachment_indexes {
        let attachment: Attachment<'_> =
            mcap::read::attachment(recording, index).expect("a complete recording");
        writer.attach(&attachment).expect("memory");
    }
    writer.finish().expect("memory");
    writer.into_inner().into_inner()
}
