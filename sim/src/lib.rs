//! Simulated rigs in MuJoCo, behind the traits of `drivers`.
