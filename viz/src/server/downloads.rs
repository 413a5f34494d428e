//! Files that clients can download: the saved model in several formats, and the report of a run.
//!
//! Any client that the server accepts may download them, including viewers. The files contain only
//! the model and the results, which viewers can see on the page. A client can only name an entry of
//! the published list, never a path.

use crate::Hub;
use crate::topics::published_data::FileLink;
use axum::body::{Body, Bytes};
use axum::http::{HeaderName, StatusCode, header};
use axum::response::{IntoResponse, Response};
use futures_util::stream::{self, Stream};
use std::fmt::{Debug, Formatter, Write};
use std::fs::File;
use std::io::Read;
use std::sync::Arc;
use tokio::sync::{OwnedSemaphorePermit, Semaphore};
use tokio::task::spawn_blocking;

/// Folder of the files in URLs.
const FOLDER: &str = "files";
/// Files are read and sent in pieces of this size, bytes, so that large ones need little memory.
const PIECE_BYTES: u64 = 256 * 1024;
/// Maximum number of files that are opened or converted at once. A conversion holds a whole model
/// in memory and keeps one processor busy, which rendering of pictures needs, too.
const MAX_CONVERSIONS: usize = 1;
/// Maximum number of files that wait, are converted or are sent at once. A converted file takes disk
/// space until it is sent, which a slow client can delay.
const MAX_DOWNLOADS: usize = 8;
/// Content security policy of a report. It allows the styles and the embedded pictures of the
/// report. Scripts and requests are not allowed, whatever a file contains.
const REPORT_POLICY: &str = "default-src 'none'; img-src data:; style-src 'unsafe-inline'; base-uri 'none'; form-action 'none'; \
     frame-ancestors 'none'; sandbox";

/// Opens a file at its beginning. The file may be made for this request. The error is a sentence
/// for the client. The function runs on a thread that may block.
pub type OpenFile = dyn Fn() -> Result<File, String> + Send + Sync;

/// A file that clients can download.
#[derive(Clone)]
pub struct ServedFile {
    /// Name in the URL: letters, digits, `-`, `_` and `.`.
    pub name: String,
    /// What the file contains, for display.
    pub label: String,
    /// Name under which browsers save the file; `None` for an HTML page, which browsers show.
    pub save_as: Option<String>,
    /// Opens the file.
    pub open: Arc<OpenFile>,
}

impl Debug for ServedFile {
    fn fmt(&self, formatter: &mut Formatter<'_>) -> std::fmt::Result {
        formatter
            .debug_struct("ServedFile")
            .field("name", &self.name)
            .field("save_as", &self.save_as)
            .finish_non_exhaustive()
    }
}

/// The published files.
type ServedFiles = Arc<[ServedFile]>;

/// Replaces the files that clients of a hub can download. The status lists them.
pub fn publish_files(hub: &Hub, files: Vec<ServedFile>) {
    let link = |file: &ServedFile| FileLink {
        path: format!("{FOLDER}/{}", file.name),
        label: file.label.clone(),
        is_page: file.save_as.is_none(),
    };
    let links = files.iter().map(link).collect();
    // The files are published before the links, so that no client requests a file that is not
    // served yet.
    hub.latest::<Option<ServedFiles>>()
        .send_replace(Some(files.into()));
    hub.change_status(|status| status.files = links);
}

/// Responds to requests of files.
#[derive(Clone)]
pub(crate) struct FileServer {
    hub: Hub,
    conversions: Arc<Semaphore>,
    downloads: Arc<Semaphore>,
}

impl FileServer {
    /// A server of the files of a hub.
    pub(crate) fn new(hub: Hub) -> Self {
        Self {
            hub,
            conversions: Arc::new(Semaphore::new(MAX_CONVERSIONS)),
            downloads: Arc::new(Semaphore::new(MAX_DOWNLOADS)),
        }
    }

    /// The file with this name in the published list.
    pub(crate) async fn respond(&self, name: &str) -> Response {
        let published = self.hub.latest::<Option<ServedFiles>>().borrow().clone();
        let files = published.as_deref().unwrap_or_default();
        let Some(file) = files.iter().find(|file| file.name == name) else {
            let reason = "the server offers no file with this name";
            return (StatusCode::NOT_FOUND, reason).into_response();
        };
        let Ok(permit) = Arc::clone(&self.downloads).try_acquire_owned() else {
            let reason = format!(
                "{MAX_DOWNLOADS} files are being downloaded already; try again when one is complete"
            );
            return (StatusCode::SERVICE_UNAVAILABLE, reason).into_response();
        };
        match self.open(file).await {
            Ok((opened, n_bytes)) => response(
                file,
                Opened {
                    file: opened,
                    n_bytes,
                    _permit: permit,
                },
            ),
            Err(reason) => (StatusCode::INTERNAL_SERVER_ERROR, reason).into_response(),
        }
    }

    /// Opens a file, and returns its size in bytes.
    async fn open(&self, file: &ServedFile) -> Result<(File, u64), String> {
        let permit = Arc::clone(&self.conversions)
            .acquire_owned()
            .await
            .map_err(|error| error.to_string())?;
        let open = Arc::clone(&file.open);
        let opened = spawn_blocking(move || {
            // The permit is held until the conversion has ended, even if the client no longer waits
            // for it.
            let _permit = permit;
            let opened = open()?;
            let metadata = opened.metadata().map_err(|error| error.to_string())?;
            Ok((opened, metadata.len()))
        });
        opened.await.map_err(|error| error.to_string())?
    }
}

/// A file that is ready to be sent.
struct Opened {
    file: File,
    /// Number of bytes that have not been sent.
    n_bytes: u64,
    /// Permit for one of the downloads. It is held until the file is sent or the client has
    /// disconnected.
    _permit: OwnedSemaphorePermit,
}

fn response(file: &ServedFile, opened: Opened) -> Response {
    let shared = [
        (header::CONTENT_LENGTH, opened.n_bytes.to_string()),
        // Edits change the files, so browsers must not keep them.
        (header::CACHE_CONTROL, "no-store".to_owned()),
    ];
    let special: [(HeaderName, String); 2] = match &file.save_as {
        Some(name) => [
            (header::CONTENT_TYPE, "application/octet-stream".to_owned()),
            (header::CONTENT_DISPOSITION, content_disposition(name)),
        ],
        None => [
            (header::CONTENT_TYPE, "text/html; charset=utf-8".to_owned()),
            (header::CONTENT_SECURITY_POLICY, REPORT_POLICY.to_owned()),
        ],
    };
    (shared, special, Body::from_stream(pieces(opened))).into_response()
}

/// The content of a file. If the file becomes shorter meanwhile, the stream ends with an error, so
/// that the client does not use an incomplete file.
fn pieces(opened: Opened) -> impl Stream<Item = std::io::Result<Bytes>> + Send {
    stream::try_unfold(opened, |mut opened| async move {
        if opened.n_bytes == 0 {
            return Ok(None);
        }
        let piece = spawn_blocking(move || {
            let n_piece = opened.n_bytes.min(PIECE_BYTES);
            let length = usize::try_from(n_piece).expect("a piece fits in memory");
            let mut piece = vec![0; length];
            opened.file.read_exact(&mut piece)?;
            opened.n_bytes -= n_piece;
            Ok::<_, std::io::Error>(Some((Bytes::from(piece), opened)))
        });
        piece.await.map_err(std::io::Error::other)?
    })
}

/// The header that makes browsers save a file under a name (RFC 6266). Names with other letters
/// than ASCII are percent-encoded (RFC 8187), after an ASCII form for old clients.
fn content_disposition(name: &str) -> String {
    let is_plain = |byte: u8| byte.is_ascii_alphanumeric() || b"-_.".contains(&byte);
    let ascii: String = name
        .chars()
        .map(|letter| u8::try_from(letter).ok().filter(|byte| is_plain(*byte)))
        .map(|byte| byte.map_or('_', char::from))
        .collect();
    let mut value = format!("attachment; filename=\"{ascii}\"");
    if ascii != name {
        value.push_str("; filename*=UTF-8''");
        for byte in name.bytes() {
            if is_plain(byte) {
                value.push(char::from(byte));
            } else {
                write!(value, "%{byte:02X}").expect("a String never fails");
            }
        }
    }
    value
}

#[cfg(test)]
mod tests {
    use super::content_disposition;

    #[test]
    fn file_names_cannot_break_the_header() {
        for (name, expected) in [
            ("kitchen-1.spz", "attachment; filename=\"kitchen-1.spz\""),
            (
                "my \"scan\"\r\n.ply",
                "attachment; filename=\"my__scan___.ply\"; filename*=UTF-8''my%20%22scan%22%0D%0A.ply",
            ),
            (
                "Küche.ply",
                "attachment; filename=\"K_che.ply\"; filename*=UTF-8''K%C3%BCche.ply",
            ),
        ] {
            assert_eq!(content_disposition(name), expected);
        }
    }
}
