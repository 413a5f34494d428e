//! Samples in, keyframes out.
