//! Parts of reports. They are charts, tables, pictures that are embedded in a page, and the pages
//! of calibrations. All pages work offline.
//!
//! A [`chart::Chart`] is drawn once for SVG and PNG. A [`Table`] is printed as HTML or as text. The
//! reports in [`calibration_report`] are whole pages.
//!
//! ```
//! use report::Table;
//!
//! let table = Table {
//!     title: "Sizes".to_owned(),
//!     head: vec!["model".to_owned(), "MB".to_owned()],
//!     rows: vec![vec!["splat".to_owned(), "12.5".to_owned()]],
//! };
//! assert!(table.html().contains("<td>splat</td><td>12.5</td>"));
//! assert_eq!(table.text(), "\nSizes\n  model    MB\n  splat  12.5");
//! ```

pub mod calibration_report;
pub mod chart;
pub mod inline_picture;
pub mod table;

pub use table::Table;

/// Style sheet of all reports.
pub const STYLE: &str = include_str!("style.css");
