//! Neural radiance fields: a hash grid and two small networks that tell density and color of any point.

pub mod reference;
