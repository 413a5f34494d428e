//! Packages of RTDE, protocol version 2: a big-endian 16-bit size, a type, and the payload.

/// Version of the protocol that this driver speaks.
pub(super) const PROTOCOL_VERSION: u16 = 2;
/// Size of the header: two bytes for the size of the package, and one for its type.
const HEADER_BYTES: usize = 3;
/// Number of bytes of a foreign protocol that a message shows: the first words of its greeting.
const MAX_SHOWN_BYTES: usize = 24;

/// Type of a package. The values are ASCII letters.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum PackageType {
    RequestProtocolVersion,
    GetControllerVersion,
    TextMessage,
    Data,
    SetupOutputs,
    SetupInputs,
    Start,
    Pause,
}

/// All types with their values.
const TYPES: [(PackageType, u8); 8] = [
    (PackageType::RequestProtocolVersion, b'V'),
    (PackageType::GetControllerVersion, b'v'),
    (PackageType::TextMessage, b'M'),
    (PackageType::Data, b'U'),
    (PackageType::SetupOutputs, b'O'),
    (PackageType::SetupInputs, b'I'),
    (PackageType::Start, b'S'),
    (PackageType::Pause, b'P'),
];

impl PackageType {
    fn value(self) -> u8 {
        let entry = TYPES.iter().find(|(known, _)| *known == self);
        entry.expect("the table has all types").1
    }

    fn of_value(value: u8) -> Option<Self> {
        TYPES
            .iter()
            .find(|(_, known)| *known == value)
            .map(|(package_type, _)| *package_type)
    }
}

/// A received package without its header.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct Package {
    pub(super) package_type: PackageType,
    pub(super) payload: Vec<u8>,
}

/// Encodes a package. Payloads of this driver are far below the maximum of 65532 bytes.
pub(super) fn encode(package_type: PackageType, payload: &[u8]) -> Vec<u8> {
    let size = u16::try_from(HEADER_BYTES + payload.len()).unwrap_or(u16::MAX);
    let mut bytes = size.to_be_bytes().to_vec();
    bytes.push(package_type.value());
    bytes.extend_from_slice(payload);
    bytes
}

/// The peer sent bytes that are no package of RTDE.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("it sent \"{}\", which is no package of RTDE", .start.escape_ascii())]
pub(super) struct NotRtde {
    /// The first bytes, which often name the protocol of the peer.
    start: Vec<u8>,
}

impl NotRtde {
    fn new(bytes: &[u8]) -> Self {
        Self {
            start: bytes[..bytes.len().min(MAX_SHOWN_BYTES)].to_vec(),
        }
    }
}

/// Splits the bytes of a TCP stream into packages.
#[derive(Debug, Default)]
pub(super) struct PackageSplitter {
    buffer: Vec<u8>,
}

impl PackageSplitter {
    /// Adds received bytes.
    pub(super) fn push(&mut self, bytes: &[u8]) {
        self.buffer.extend_from_slice(bytes);
    }

    /// The next complete package; `None` until more bytes arrive.
    ///
    /// # Errors
    /// If the bytes are not RTDE. The stream has no markers, so the next package cannot be found,
    /// and the connection must be closed.
    pub(super) fn next(&mut self) -> Result<Option<Package>, NotRtde> {
        let [high, low, value, ..] = *self.buffer else {
            return Ok(None);
        };
        let size = usize::from(u16::from_be_bytes([high, low]));
        let Some(package_type) = PackageType::of_value(value).filter(|_| size >= HEADER_BYTES)
        else {
            return Err(NotRtde::new(&self.buffer));
        };
        if self.buffer.len() < size {
            return Ok(None);
        }
        let payload = self.buffer[HEADER_BYTES..size].to_vec();
        self.buffer.drain(..size);
        Ok(Some(Package {
            package_type,
            payload,
        }))
    }
}

/// The names in a list of variables or types. Some clients end the list with a comma.
pub(super) fn decode_names(list: &[u8]) -> Vec<String> {
    let list = String::from_utf8_lossy(list);
    let names = list.split(',').map(str::trim);
    names
        .filter(|name| !name.is_empty())
        .map(str::to_owned)
        .collect()
}

/// A text message of the controller as one line, with its source. `None` if it is malformed.
pub(super) fn decode_text(payload: &[u8]) -> Option<String> {
    let (n_bytes, rest) = payload.split_first()?;
    let (text, rest) = rest.split_at_checked(usize::from(*n_bytes))?;
    let (n_bytes, rest) = rest.split_first()?;
    let (source, _level) = rest.split_at_checked(usize::from(*n_bytes))?;
    // The text goes to the log, where control characters could hide other lines.
    let printable = |bytes: &[u8]| -> String {
        let text = String::from_utf8_lossy(bytes);
        text.chars().filter(|c| !c.is_control()).collect()
    };
    Some(format!("{} ({})", printable(text), printable(source)))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn packages_are_found_at_any_split_of_the_stream() {
        let packages = [
            (PackageType::RequestProtocolVersion, vec![0, 2]),
            (PackageType::Start, vec![]),
            (PackageType::Data, (0..=255).collect()),
        ];
        let bytes: Vec<u8> = packages
            .iter()
            .flat_map(|(package_type, payload)| encode(*package_type, payload))
            .collect();
        assert_eq!(bytes[..5], [0, 5, b'V', 0, 2], "as in the RTDE guide");
        for n_at_once in 1..bytes.len() {
            let mut splitter = PackageSplitter::default();
            let mut found = Vec::new();
            for part in bytes.chunks(n_at_once) {
                splitter.push(part);
                while let Some(package) = splitter.next().unwrap() {
                    found.push((package.package_type, package.payload));
                }
            }
            assert_eq!(found, packages, "{n_at_once} bytes at once");
        }
    }

    #[test]
    fn bytes_that_are_not_rtde_are_an_error() {
        for (bytes, shown) in [
            (&[0, 2, b'U'][..], r#"it sent "\x00\x02U", "#),
            (
                b"HTTP/1.1 400 Bad Request\r\nServer: nginx",
                r#"it sent "HTTP/1.1 400 Bad Request", "#,
            ),
            (b"SSH-2.0-OpenSSH_9.2\r\n", r#""SSH-2.0-OpenSSH_9.2\r\n""#),
            // The primary interface of a controller begins with the size in four bytes.
            (&[0, 0, 0, 79, 16], r#""\x00\x00\x00O\x10""#),
        ] {
            let mut splitter = PackageSplitter::default();
            splitter.push(bytes);
            let error = splitter.next().unwrap_err().to_string();
            assert!(error.contains(shown), "{error}");
        }
    }

    #[test]
    fn lists_of_names_may_end_with_a_comma() {
        // ur_rtde ends its lists of variables in this way.
        assert_eq!(
            decode_names(b"timestamp,actual_q,"),
            ["timestamp", "actual_q"]
        );
        assert_eq!(decode_names(b""), [""; 0]);
    }

    #[test]
    fn text_messages_become_one_line() {
        let payload = [&[5], &b"a\nb c"[..], &[4], b"RTDE", &[2]].concat();
        assert_eq!(decode_text(&payload).as_deref(), Some("ab c (RTDE)"));
        for n in 0..payload.len() - 1 {
            assert_eq!(decode_text(&payload[..n]), None, "{n} bytes");
        }
    }
}
