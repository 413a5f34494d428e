//! Limits for the readers of all formats, which are checked before memory is allocated.

use std::fmt;

/// Memory for decoded data that any input may use, bytes. A small file, such as an image of one
/// color, may expand by a large factor. With a larger value, many small files could fill the
/// memory.
const FREE_BYTES: u64 = 64 << 20;

/// Limits for one input. The sizes that the input declares are checked against the limits before
/// memory is allocated.
///
/// Nesting is not limited here. The parsers of JSON and TOML stop at 128 levels or fewer. Robot
/// descriptions are parsed without recursion, with the limits of `kinematics::urdf`. Time is not
/// limited either, because the time of all readers is linear in the size of their input.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Budget {
    /// Size of the input, bytes.
    pub max_bytes: u64,
    /// Number of elements after decoding: pixels, splats, nodes or tables.
    pub max_elements: u64,
    /// Maximum memory of decoded data per byte of the input. Up to 64 MiB are always allowed.
    pub max_expansion: u64,
}

impl Budget {
    /// Texts: rig files, lists, reports, samples.
    pub const TEXT: Self = Self {
        max_bytes: 64 << 20,
        max_elements: u64::MAX,
        max_expansion: u64::MAX,
    };
    /// Tables in a rig file whose names the user chooses: cameras, scanners, motors or tags.
    pub const RIG_TABLES: Self = Self {
        max_elements: 1000,
        ..Self::TEXT
    };
    /// Meshes of a robot, which are passed on without decoding.
    pub const MESH: Self = Self {
        max_bytes: 64 << 20,
        max_elements: u64::MAX,
        max_expansion: 1,
    };
    /// All meshes of a robot together.
    pub const MESHES: Self = Self {
        max_bytes: 256 << 20,
        ..Self::MESH
    };
    /// Color images. Elements are pixels. A small file of a uniform image can contain very many
    /// pixels.
    pub const COLOR_IMAGE: Self = Self {
        max_bytes: 1 << 30,
        // 134 megapixels take 512 MiB as RGBA.
        max_elements: 1 << 27,
        max_expansion: u64::MAX,
    };
    /// Depth images. Elements are pixels.
    pub const DEPTH_IMAGE: Self = Self {
        // No depth camera has 33 megapixels. An image of this size takes 128 MiB as f32.
        max_elements: 1 << 25,
        ..Self::COLOR_IMAGE
    };
    /// Records of recordings. The largest record contains one image. Compressed records expand to
    /// at most this size, too.
    pub const RECORD: Self = Self {
        max_bytes: 512 << 20,
        max_elements: u64::MAX,
        max_expansion: u64::MAX,
    };
    /// Files of splats. Compressed files expand by a factor of 2 to 4.
    pub const SPLATS: Self = Self {
        max_bytes: u64::MAX,
        max_elements: 100_000_000,
        // The limit is far above the factor of real files. It is far below the factor of a file
        // that was made to fill the memory.
        max_expansion: 50,
    };
    /// Point clouds from which training starts.
    pub const POINTS: Self = Self {
        max_bytes: 1 << 30,
        ..Self::SPLATS
    };
    /// Files whose decoded data is not larger than the file, such as checkpoints and weights. Only
    /// the disk limits their size.
    pub const PLAIN: Self = Self {
        max_bytes: u64::MAX,
        max_elements: u64::MAX,
        max_expansion: 1,
    };

    /// Checks the size of an input.
    ///
    /// # Errors
    /// Fails if the input is larger.
    pub fn check_bytes(&self, n_bytes: u64) -> Result<(), OverBudget> {
        if n_bytes > self.max_bytes {
            return Err(OverBudget::Bytes {
                n_bytes,
                max_bytes: self.max_bytes,
            });
        }
        Ok(())
    }

    /// Checks a number of elements that an input declares.
    ///
    /// # Errors
    /// Fails if there are more elements.
    pub fn check_elements(&self, n: u64) -> Result<(), OverBudget> {
        if n > self.max_elements {
            return Err(OverBudget::Elements {
                n,
                max: self.max_elements,
            });
        }
        Ok(())
    }

    /// Checks the size of decoded data that an input of `n_input_bytes` declares.
    ///
    /// # Errors
    /// Fails if an input of this size cannot contain as much data.
    pub fn check_decoded(
        &self,
        n_decoded_bytes: u64,
        n_input_bytes: u64,
    ) -> Result<(), OverBudget> {
        // The product saturates, so that a budget with unlimited expansion accepts any size.
        if n_decoded_bytes > FREE_BYTES.max(self.max_expansion.saturating_mul(n_input_bytes)) {
            return Err(OverBudget::Decoded {
                n_decoded_bytes,
                n_input_bytes,
            });
        }
        Ok(())
    }

    /// The budget for the rest of the input after a part with `n_bytes`.
    #[must_use]
    pub fn after(&self, n_bytes: u64) -> Self {
        Self {
            max_bytes: self.max_bytes.saturating_sub(n_bytes),
            ..*self
        }
    }
}

/// An input that exceeds its budget.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum OverBudget {
    /// It is too large.
    Bytes {
        /// Its size.
        n_bytes: u64,
        /// Maximum size.
        max_bytes: u64,
    },
    /// It declares too many elements.
    Elements {
        /// Their number.
        n: u64,
        /// Maximum number.
        max: u64,
    },
    /// The input declares more decoded data than it can contain.
    Decoded {
        /// Size of the decoded data.
        n_decoded_bytes: u64,
        /// Size of the input.
        n_input_bytes: u64,
    },
}

impl fmt::Display for OverBudget {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Bytes { n_bytes, max_bytes } => {
                write!(f, "it has {n_bytes} bytes, at most {max_bytes} are read")
            }
            Self::Elements { n, max } => write!(f, "it declares {n}, expected at most {max}"),
            Self::Decoded {
                n_decoded_bytes,
                n_input_bytes,
            } => {
                write!(
                    f,
                    "it declares {n_decoded_bytes} bytes, which {n_input_bytes} bytes cannot contain"
                )
            }
        }
    }
}

impl std::error::Error for OverBudget {}

impl From<OverBudget> for std::io::Error {
    fn from(error: OverBudget) -> Self {
        let kind = match error {
            OverBudget::Bytes { .. } => std::io::ErrorKind::FileTooLarge,
            OverBudget::Elements { .. } | OverBudget::Decoded { .. } => {
                std::io::ErrorKind::InvalidData
            }
        };
        Self::new(kind, error.to_string())
    }
}

#[cfg(test)]
mod tests {
    use super::{Budget, FREE_BYTES, OverBudget};

    #[test]
    fn limits_are_inclusive_and_small_inputs_have_free_memory() {
        let budget = Budget {
            max_bytes: 10,
            max_elements: 3,
            max_expansion: 2,
        };
        assert_eq!(budget.check_bytes(10), Ok(()));
        assert_eq!(
            budget.check_bytes(11),
            Err(OverBudget::Bytes {
                n_bytes: 11,
                max_bytes: 10
            })
        );
        assert_eq!(
            budget.after(4).check_bytes(7),
            Err(OverBudget::Bytes {
                n_bytes: 7,
                max_bytes: 6
            })
        );
        assert_eq!(budget.after(11).max_bytes, 0);
        assert_eq!(budget.check_elements(3), Ok(()));
        assert_eq!(
            budget.check_elements(4),
            Err(OverBudget::Elements { n: 4, max: 3 })
        );
        assert_eq!(budget.check_decoded(FREE_BYTES, 1), Ok(()));
        assert!(budget.check_decoded(FREE_BYTES + 1, 1).is_err());
        assert_eq!(budget.check_decoded(2 * FREE_BYTES, FREE_BYTES), Ok(()));
        assert!(
            budget
                .check_decoded(2 * FREE_BYTES + 1, FREE_BYTES)
                .is_err()
        );
        assert_eq!(
            Budget::TEXT.check_decoded(u64::MAX, 2),
            Ok(()),
            "no overflow"
        );
    }

    #[test]
    fn errors_name_value_and_limit() {
        let too_large = Budget::TEXT.check_bytes(65 << 20).expect_err("too large");
        assert_eq!(
            too_large.to_string(),
            "it has 68157440 bytes, at most 67108864 are read"
        );
        assert_eq!(
            std::io::Error::from(too_large).kind(),
            std::io::ErrorKind::FileTooLarge
        );
    }
}
