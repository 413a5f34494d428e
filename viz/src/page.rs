//! The web page inside the binary.

/// A file of the page.
pub(crate) struct PageFile {
    /// Path of the URL.
    pub(crate) path: &'static str,
    /// MIME type.
    pub(crate) content_type: &'static str,
    /// The file.
    pub(crate) bytes: &'static [u8],
}

/// The page that `scripts/build-web.sh` bundled.
#[cfg(web_bundle)]
pub(crate) const FILES: &[PageFile] = &[
    PageFile { path: "/", content_type: "text/html; charset=utf-8", bytes: include_bytes!("../web/dist/index.html") },
    PageFile {
        path: "/app.js",
        content_type: "text/javascript; charset=utf-8",
        bytes: include_bytes!("../web/dist/app.js"),
    },
    PageFile {
        path: "/app.css",
        content_type: "text/css; charset=utf-8",
        bytes: include_bytes!("../web/dist/app.css"),
    },
];

/// The page of a binary that was built without Node.
#[cfg(not(web_bundle))]
pub(crate) const FILES: &[PageFile] =
    &[PageFile { path: "/", content_type: "text/html; charset=utf-8", bytes: include_bytes!("without_bundle.html") }];
