//! The web page embedded in the binary.

use axum::http::{HeaderMap, HeaderName, StatusCode, header};
use axum::response::{IntoResponse, Response};

/// A file of the page.
pub(crate) struct PageFile {
    /// Path of the URL.
    pub(crate) path: &'static str,
    content_type: &'static str,
    bytes: &'static [u8],
    gzip: &'static [u8],
}

/// A file compressed by `build.rs`.
macro_rules! page_file {
    ($path:literal, $content_type:literal, $folder:literal, $name:literal) => {
        PageFile {
            path: $path,
            content_type: $content_type,
            bytes: include_bytes!(concat!($folder, $name)),
            gzip: include_bytes!(concat!(env!("OUT_DIR"), "/", $name, ".gz")),
        }
    };
}

/// The page bundled by `scripts/build-web.sh`.
#[cfg(web_bundle)]
pub(crate) const FILES: &[PageFile] = &[
    page_file!(
        "/",
        "text/html; charset=utf-8",
        "../../web/dist/",
        "index.html"
    ),
    page_file!(
        "/app.js",
        "text/javascript; charset=utf-8",
        "../../web/dist/",
        "app.js"
    ),
    page_file!(
        "/splat_worker.js",
        "text/javascript; charset=utf-8",
        "../../web/dist/",
        "splat_worker.js"
    ),
    page_file!(
        "/video_worker.js",
        "text/javascript; charset=utf-8",
        "../../web/dist/",
        "video_worker.js"
    ),
    page_file!(
        "/mesh_loaders.js",
        "text/javascript; charset=utf-8",
        "../../web/dist/",
        "mesh_loaders.js"
    ),
    page_file!(
        "/coverage.js",
        "text/javascript; charset=utf-8",
        "../../web/dist/",
        "coverage.js"
    ),
    page_file!(
        "/study_page.js",
        "text/javascript; charset=utf-8",
        "../../web/dist/",
        "study_page.js"
    ),
    page_file!(
        "/workspace_page.js",
        "text/javascript; charset=utf-8",
        "../../web/dist/",
        "workspace_page.js"
    ),
    page_file!(
        "/steering.js",
        "text/javascript; charset=utf-8",
        "../../web/dist/",
        "steering.js"
    ),
    page_file!(
        "/headset.js",
        "text/javascript; charset=utf-8",
        "../../web/dist/",
        "headset.js"
    ),
    page_file!(
        "/app.css",
        "text/css; charset=utf-8",
        "../../web/dist/",
        "app.css"
    ),
];

/// The page of binaries built without Node.js.
#[cfg(not(web_bundle))]
pub(crate) const FILES: &[PageFile] = &[
    page_file!("/", "text/html; charset=utf-8", "", "without_bundle.html"),
    page_file!(
        "/app.css",
        "text/css; charset=utf-8",
        "",
        "without_bundle.css"
    ),
];

impl PageFile {
    /// The response to a GET request: the file, compressed if the client accepts it, or 304 if the
    /// client has this version.
    pub(crate) fn response(&self, request: &HeaderMap) -> Response {
        // Browsers ask for every file each time, so that a page of an older version never talks to
        // this server.
        let etag = self.etag();
        let shared: [(HeaderName, &str); 3] = [
            (header::ETAG, &etag),
            (header::CACHE_CONTROL, "no-cache"),
            (header::VARY, "accept-encoding"),
        ];
        if has_version(request, &etag) {
            return (StatusCode::NOT_MODIFIED, shared).into_response();
        }
        let content_type = [(header::CONTENT_TYPE, self.content_type)];
        if accepts_gzip(request) {
            (
                shared,
                content_type,
                [(header::CONTENT_ENCODING, "gzip")],
                self.gzip,
            )
                .into_response()
        } else {
            (shared, content_type, self.bytes).into_response()
        }
    }

    /// Checksum and size of the file, taken from the last bytes of its gzip form. The tag is weak
    /// because both encodings share it.
    fn etag(&self) -> String {
        // A gzip file ends with the CRC-32 and the length of its content (RFC 1952, section 2.3.1).
        let trailer = &self.gzip[self.gzip.len() - 8..];
        let hex: String = trailer.iter().map(|byte| format!("{byte:02x}")).collect();
        format!("W/\"{hex}\"")
    }
}

/// Items of a comma-separated header.
fn items(request: &HeaderMap, name: HeaderName) -> impl Iterator<Item = &str> {
    let values = request
        .get_all(name)
        .into_iter()
        .filter_map(|value| value.to_str().ok());
    values.flat_map(|value| value.split(',')).map(str::trim)
}

/// Whether the client already has the version of a file with this `ETag`.
pub(crate) fn has_version(request: &HeaderMap, etag: &str) -> bool {
    // The weak comparison of RFC 9110, section 13.1.2, ignores whether tags are weak.
    let opaque = |tag: &str| tag.trim_start_matches("W/").to_owned();
    items(request, header::IF_NONE_MATCH).any(|item| item == "*" || opaque(item) == opaque(etag))
}

fn accepts_gzip(request: &HeaderMap) -> bool {
    items(request, header::ACCEPT_ENCODING).any(|item| {
        // A weight of 0 means that the coding is not acceptable (RFC 9110, section 12.4.2).
        let (coding, weight) = item.split_once(';').unwrap_or((item, ""));
        let is_excluded = weight
            .trim()
            .strip_prefix("q=")
            .and_then(|q| q.parse::<f64>().ok())
            == Some(0.0);
        coding.trim().eq_ignore_ascii_case("gzip") && !is_excluded
    })
}

#[cfg(test)]
mod tests {
    use super::{accepts_gzip, has_version};
    use axum::http::{HeaderMap, HeaderValue, header};

    #[test]
    fn gzip_is_sent_only_to_clients_that_accept_it() {
        for (value, expected) in [
            ("gzip, deflate, br", true),
            ("br;q=1.0, GZIP;q=0.8", true),
            ("identity", false),
            ("gzip;q=0", false),
            ("gzip; q=0.0, br", false),
            ("x-gzip", false),
        ] {
            let headers =
                HeaderMap::from_iter([(header::ACCEPT_ENCODING, HeaderValue::from_static(value))]);
            assert_eq!(accepts_gzip(&headers), expected, "{value}");
        }
        assert!(!accepts_gzip(&HeaderMap::new()));
    }

    #[test]
    fn a_version_is_recognized_in_a_list() {
        for (value, expected) in [
            ("\"a\", W/\"b\"", true),
            ("\"b\"", true),
            ("*", true),
            ("\"c\"", false),
        ] {
            let headers =
                HeaderMap::from_iter([(header::IF_NONE_MATCH, HeaderValue::from_static(value))]);
            assert_eq!(has_version(&headers, "W/\"b\""), expected, "{value}");
        }
    }
}
