//! The operator's window: a render server and its web page.
