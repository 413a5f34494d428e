//! A CAN frame as plain data, and the time it takes on the bus.
//!
//! Sources: Robert Bosch, CAN Specification 2.0 (1991), parts A and B, and ISO 11898-1:2015 for FD
//! frames and their fixed stuff bits. Frames are divided into the same fields as in Linux's
//! `include/linux/can/length.h`. The worst stuffing of classic frames is from Davis, Burns, Bril
//! and Lukkien 2007 (Controller Area Network schedulability analysis: refuted, revisited and
//! revised), equation 1.

use super::CanError;

/// Payload lengths of FD frames above eight bytes.
const FD_LENGTHS: [usize; 7] = [12, 16, 20, 24, 32, 48, 64];
/// Acknowledge slot and delimiter, end of frame, and interframe space.
const TAIL_BITS: u32 = 2 + 7 + 3;

/// CAN ID of a frame. Frames with lower IDs have priority on the bus.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct Id {
    value: u32,
    extended: bool,
}

impl Id {
    /// An 11-bit identifier.
    pub const fn standard(value: u32) -> Result<Self, CanError> {
        match value {
            0..=0x7FF => Ok(Self {
                value,
                extended: false,
            }),
            id => Err(CanError::IdRange { id, bits: 11 }),
        }
    }

    /// A 29-bit identifier.
    pub const fn extended(value: u32) -> Result<Self, CanError> {
        match value {
            0..=0x1FFF_FFFF => Ok(Self {
                value,
                extended: true,
            }),
            id => Err(CanError::IdRange { id, bits: 29 }),
        }
    }

    /// The number.
    pub const fn value(self) -> u32 {
        self.value
    }

    /// Whether it has 29 bits.
    pub const fn is_extended(self) -> bool {
        self.extended
    }
}

/// Format of a frame.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Kind {
    Classic,
    Remote,
    Fd { switched: bool },
}

/// One frame.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Frame {
    id: Id,
    kind: Kind,
    n_bytes: usize,
    bytes: [u8; 64],
}

impl Frame {
    /// A classic data frame of up to eight bytes.
    pub fn classic(id: Id, data: &[u8]) -> Result<Self, CanError> {
        match data.len() {
            0..=8 => Ok(Self::with_data(id, Kind::Classic, data)),
            got_bytes => Err(CanError::PayloadLength {
                format: "classic",
                got_bytes,
            }),
        }
    }

    /// A remote frame, which requests the data frame with the same identifier. `n_bytes` is the
    /// expected length of the answer.
    pub fn remote(id: Id, n_bytes: usize) -> Result<Self, CanError> {
        match n_bytes {
            0..=8 => Ok(Self {
                id,
                kind: Kind::Remote,
                n_bytes,
                bytes: [0; 64],
            }),
            got_bytes => Err(CanError::PayloadLength {
                format: "classic",
                got_bytes,
            }),
        }
    }

    /// An FD frame of 0 to 8, 12, 16, 20, 24, 32, 48 or 64 bytes. `switched` states whether the
    /// data phase uses the data bit rate.
    pub fn fd(id: Id, data: &[u8], switched: bool) -> Result<Self, CanError> {
        match data.len() {
            n if n <= 8 || FD_LENGTHS.contains(&n) => {
                Ok(Self::with_data(id, Kind::Fd { switched }, data))
            }
            got_bytes => Err(CanError::PayloadLength {
                format: "FD",
                got_bytes,
            }),
        }
    }

    fn with_data(id: Id, kind: Kind, data: &[u8]) -> Self {
        let mut bytes = [0; 64];
        bytes[..data.len()].copy_from_slice(data);
        Self {
            id,
            kind,
            n_bytes: data.len(),
            bytes,
        }
    }

    /// The identifier.
    pub fn id(&self) -> Id {
        self.id
    }

    /// The payload. It is empty in a remote frame.
    pub fn data(&self) -> &[u8] {
        match self.kind {
            Kind::Remote => &[],
            Kind::Classic | Kind::Fd { .. } => &self.bytes[..self.n_bytes],
        }
    }

    /// Length of the payload, or the requested length of a remote frame.
    pub fn n_bytes(&self) -> usize {
        self.n_bytes
    }

    /// Whether it is a remote frame, which requests data.
    pub fn is_remote(&self) -> bool {
        self.kind == Kind::Remote
    }

    /// Whether it is an FD frame.
    pub fn is_fd(&self) -> bool {
        matches!(self.kind, Kind::Fd { .. })
    }

    /// Whether its data phase uses the data bit rate.
    pub fn is_switched(&self) -> bool {
        matches!(self.kind, Kind::Fd { switched: true })
    }

    /// Length in bits from the start of frame to the earliest start of the next frame, without
    /// errors and retransmissions.
    ///
    /// The fixed stuff bits of FD frames are always included. The two bits in which the rate
    /// switches (bit rate switch and CRC delimiter) are sent partly at each rate. Here, they are
    /// counted at the nominal rate, which is slower.
    pub fn bits(&self, stuffing: Stuffing) -> Bits {
        let n_data = u32::try_from(8 * self.data().len()).expect("at most 64 bytes");
        let n_stuff_bits = |n_bits: u32| match stuffing {
            Stuffing::None => 0,
            // A stuff bit follows five equal bits and is the first bit of the next group of five.
            // After the first stuff bit, every four bits of the frame may therefore cause another
            // stuff bit (Davis et al. 2007, equation 1).
            Stuffing::Worst => (n_bits - 1) / 4,
        };
        let Kind::Fd { switched } = self.kind else {
            // Start of frame, identifier, control, data and CRC are stuffed. The rest of the frame
            // is not stuffed.
            let stuffed = if self.id.extended { 54 } else { 34 } + n_data;
            return Bits {
                nominal: stuffed + n_stuff_bits(stuffed) + 1 + TAIL_BITS,
                data: 0,
            };
        };
        // The head ranges from the start of frame to the bit rate switch. The body contains error
        // state, length and data. The check contains stuff count, CRC and their fixed stuff bits.
        let head = if self.id.extended { 36 } else { 17 };
        let body = 5 + n_data;
        // The CRC has 17 bits for up to 16 bytes of data, and 21 bits for more data. It has its own
        // fixed stuff bits. The stuff count in front of the CRC has four bits.
        let check = if n_data <= 8 * 16 {
            4 + 17 + 6
        } else {
            4 + 21 + 7
        };
        let nominal = head + n_stuff_bits(head) + 1 + TAIL_BITS;
        // Stuffing continues across the switch of the rate, so the number of stuff bits in the data
        // phase is the number in both parts minus the number in the head.
        let data = body + n_stuff_bits(head + body) - n_stuff_bits(head) + check;
        if switched {
            Bits { nominal, data }
        } else {
            Bits {
                nominal: nominal + data,
                data: 0,
            }
        }
    }
}

/// Stuff bits that are counted in addition to the fixed stuff bits of FD frames.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Stuffing {
    /// No stuff bits, which gives the minimum length.
    None,
    /// One stuff bit after every four bits, which gives the maximum length.
    Worst,
}

/// Number of bits at each bit rate.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Bits {
    /// Number of bits at the nominal rate, which is used for arbitration and classic frames.
    pub nominal: u32,
    /// Number of bits at the data rate. It is 0 unless the frame switches the rate.
    pub data: u32,
}

/// The bit rates of a bus.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct BitRates {
    /// Nominal bit rate, bit/s.
    pub nominal_hz: f64,
    /// Data bit rate, bit/s. On a classic bus, it is equal to the nominal bit rate.
    pub data_hz: f64,
}

impl Bits {
    /// Duration on the bus, seconds.
    pub fn seconds(self, rates: BitRates) -> f64 {
        f64::from(self.nominal) / rates.nominal_hz + f64::from(self.data) / rates.data_hz
    }
}

/// Fraction of the bus capacity that frames with these rates in Hz use. It is above 1 if the bus is
/// overloaded.
pub fn load_frac(traffic: impl IntoIterator<Item = (Bits, f64)>, rates: BitRates) -> f64 {
    traffic
        .into_iter()
        .map(|(bits, rate_hz)| bits.seconds(rates) * rate_hz)
        .sum()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn standard(n_bytes: usize) -> Frame {
        Frame::classic(
            Id::standard(0x123).expect("11 bits"),
            &[0xA5; 64][..n_bytes],
        )
        .expect("classic")
    }

    fn extended(n_bytes: usize) -> Frame {
        Frame::classic(
            Id::extended(0x1_2345).expect("29 bits"),
            &[0xA5; 64][..n_bytes],
        )
        .expect("classic")
    }

    #[test]
    fn classic_frames_have_the_published_lengths() {
        // According to Davis et al. 2007, frames with s bytes have 55 + 10 s and 80 + 10 s bits in
        // the worst case.
        for n_bytes in 0..=8_usize {
            let s = u32::try_from(n_bytes).expect("small");
            let bits = |frame: Frame, stuffing| frame.bits(stuffing);
            assert_eq!(
                bits(standard(n_bytes), Stuffing::None),
                Bits {
                    nominal: 47 + 8 * s,
                    data: 0
                }
            );
            assert_eq!(
                bits(extended(n_bytes), Stuffing::None),
                Bits {
                    nominal: 67 + 8 * s,
                    data: 0
                }
            );
            assert_eq!(
                bits(standard(n_bytes), Stuffing::Worst),
                Bits {
                    nominal: 55 + 10 * s,
                    data: 0
                }
            );
            assert_eq!(
                bits(extended(n_bytes), Stuffing::Worst),
                Bits {
                    nominal: 80 + 10 * s,
                    data: 0
                }
            );
        }
        let remote = Frame::remote(Id::standard(1).expect("11 bits"), 8).expect("classic");
        assert_eq!(remote.bits(Stuffing::None).nominal, 47);
        assert!(remote.data().is_empty() && remote.n_bytes() == 8);
    }

    #[test]
    fn fd_frame_lengths_match_linux() {
        // The expected values were computed by hand from can_frame_bits(true, is_eff, bitstuffing,
        // true, n) of linux/can/length.h.
        let cases = [
            (0, false, 62, 67),
            (8, false, 126, 147),
            (16, false, 190, 227),
            (20, false, 227, 272),
        ];
        let extended = [
            (64, false, 579, 712),
            (0, true, 81, 91),
            (16, true, 209, 251),
            (64, true, 598, 736),
        ];
        for (n_bytes, is_extended, unstuffed, worst) in cases.into_iter().chain(extended) {
            let id = if is_extended {
                Id::extended(5)
            } else {
                Id::standard(5)
            }
            .expect("small");
            let frame =
                |switched| Frame::fd(id, &[0; 64][..n_bytes], switched).expect("an FD length");
            for (stuffing, expected) in [(Stuffing::None, unstuffed), (Stuffing::Worst, worst)] {
                let Bits { nominal, data } = frame(true).bits(stuffing);
                assert_eq!(
                    nominal + data,
                    expected,
                    "{n_bytes} {is_extended} {stuffing:?}"
                );
                assert_eq!(
                    frame(false).bits(stuffing),
                    Bits {
                        nominal: expected,
                        data: 0
                    }
                );
            }
        }
        let short =
            Frame::fd(Id::standard(5).expect("small"), &[0; 8], true).expect("an FD length");
        assert_eq!(
            short.bits(Stuffing::None),
            Bits {
                nominal: 30,
                data: 96
            }
        );
    }

    #[test]
    fn bus_load_is_frame_time_times_rate() {
        let rates = BitRates {
            nominal_hz: 1e6,
            data_hz: 5e6,
        };
        // Six motors have one command and one answer each, 500 times per second. A frame takes 135
        // us.
        let bits = standard(8).bits(Stuffing::Worst);
        let load = load_frac([(bits, 6.0 * 500.0), (bits, 6.0 * 500.0)], rates);
        assert!((load - 0.81).abs() < 1e-12, "{load}");
        let switched = Bits {
            nominal: 30,
            data: 100,
        };
        assert!((switched.seconds(rates) - 50e-6).abs() < 1e-15);
    }

    #[test]
    fn invalid_ids_and_lengths_are_rejected() {
        assert_eq!(
            Id::standard(0x800),
            Err(CanError::IdRange {
                id: 0x800,
                bits: 11
            })
        );
        assert_eq!(
            Id::extended(0x2000_0000),
            Err(CanError::IdRange {
                id: 0x2000_0000,
                bits: 29
            })
        );
        let id = Id::standard(0x7FF).expect("11 bits");
        assert_eq!(
            Frame::classic(id, &[0; 9]),
            Err(CanError::PayloadLength {
                format: "classic",
                got_bytes: 9
            })
        );
        assert_eq!(
            Frame::remote(id, 9),
            Err(CanError::PayloadLength {
                format: "classic",
                got_bytes: 9
            })
        );
        for n in 0..=65 {
            let is_valid = Frame::fd(id, &[0; 65][..n], false).is_ok();
            assert_eq!(
                is_valid,
                n <= 8 || [12, 16, 20, 24, 32, 48, 64].contains(&n),
                "{n}"
            );
        }
        assert_ne!(
            Id::standard(5).expect("small"),
            Id::extended(5).expect("small")
        );
    }
}
