//! Who may use a server, and what for: tokens, roles, and the origins of pages.

use axum::http::{HeaderMap, HeaderName, StatusCode, header};
use serde::Serialize;
use std::net::IpAddr;
use subtle::ConstantTimeEq;

/// Length of a token, random bytes: 128 bits cannot be guessed.
const TOKEN_BYTES: usize = 16;
/// The page keeps its token in a cookie whose name starts with this prefix and ends with the port.
/// Cookies do not distinguish ports, so a browser sends the cookies of all servers on a computer.
const COOKIE_PREFIX: &str = "__Host-fieldrig-";

/// What a client may do.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Role {
    /// Sees everything and changes nothing.
    Viewer,
    /// Also controls the run.
    Operator,
}

impl Role {
    /// The name of the role in messages.
    pub(crate) fn name(self) -> &'static str {
        match self {
            Self::Viewer => "viewer",
            Self::Operator => "operator",
        }
    }
}

/// A random secret that gives access to a server.
#[derive(Clone)]
pub struct Token(String);

impl Token {
    /// A new token from the operating system's random numbers.
    pub fn random() -> std::io::Result<Self> {
        let mut bytes = [0; TOKEN_BYTES];
        getrandom::fill(&mut bytes).map_err(std::io::Error::from)?;
        Ok(Self(
            bytes.iter().map(|byte| format!("{byte:02x}")).collect(),
        ))
    }

    /// The token as text for the fragment of a URL.
    pub fn text(&self) -> &str {
        &self.0
    }

    /// Compares in constant time, so that response times do not reveal the token.
    fn is(&self, text: &str) -> bool {
        self.0.as_bytes().ct_eq(text.as_bytes()).into()
    }
}

impl std::fmt::Debug for Token {
    fn fmt(&self, formatter: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        formatter.write_str("Token(..)") // Tokens must not appear in logs.
    }
}

/// The tokens of a server.
#[derive(Clone, Debug)]
pub struct Tokens {
    /// Makes its holder an [`Role::Operator`].
    pub operator: Token,
    /// Makes its holder a [`Role::Viewer`].
    pub viewer: Token,
}

impl Tokens {
    /// New tokens.
    pub fn random() -> std::io::Result<Self> {
        Ok(Self {
            operator: Token::random()?,
            viewer: Token::random()?,
        })
    }

    fn role_of(&self, token: &str) -> Option<Role> {
        // Both comparisons are always made, so that the time does not reveal which one succeeded.
        let is_operator = self.operator.is(token);
        let is_viewer = self.viewer.is(token);
        if is_operator {
            Some(Role::Operator)
        } else {
            is_viewer.then_some(Role::Viewer)
        }
    }
}

/// Who may use a server.
#[derive(Clone, Debug)]
pub(crate) enum Access {
    /// Everybody on this computer, as operator.
    Local,
    /// Everybody with a token, over TLS.
    Tokens(Tokens),
}

/// Why a request is refused, in one sentence.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub(crate) enum Refusal {
    #[error("only pages of this server, opened under localhost, may use it")]
    ForeignOrigin,
    #[error("only pages of this server may use it")]
    ForeignPage,
    #[error("a request must have one Host header")]
    SeveralHosts,
    #[error(
        "this server requires a token: open the complete address that fieldrig printed when it started"
    )]
    NoToken,
    #[error("invalid token: tokens change at each start; open the most recently printed address")]
    WrongToken,
}

impl Refusal {
    /// The HTTP status of the response.
    pub(crate) fn status(self) -> StatusCode {
        match self {
            Self::ForeignOrigin | Self::ForeignPage => StatusCode::FORBIDDEN,
            // A proxy and the server could use different `Host` headers (RFC 9112, section 3.2).
            Self::SeveralHosts => StatusCode::BAD_REQUEST,
            Self::NoToken | Self::WrongToken => StatusCode::UNAUTHORIZED,
        }
    }
}

impl Access {
    /// Allows only pages of this server, because other web sites in the same browser can also send
    /// requests to it.
    ///
    /// The `Host` of a local server must be a loopback address, because the domain of another site
    /// may resolve to this computer. Such a site has neither a token nor a valid certificate.
    pub(crate) fn check_origin(&self, headers: &HeaderMap) -> Result<(), Refusal> {
        if headers.get_all(header::HOST).iter().nth(1).is_some() {
            return Err(Refusal::SeveralHosts);
        }
        let text = |name| headers.get(name).and_then(|value| value.to_str().ok());
        let (scheme, refusal) = match self {
            Self::Local => ("http://", Refusal::ForeignOrigin),
            Self::Tokens(_) => ("https://", Refusal::ForeignPage),
        };
        let host = text(header::HOST).ok_or(refusal)?;
        let has_same_origin = match headers.get(header::ORIGIN) {
            None => true, // Not a browser.
            // An origin that is not text, or that is `null`, belongs to another site.
            Some(_) => {
                text(header::ORIGIN).and_then(|origin| origin.strip_prefix(scheme)) == Some(host)
            }
        };
        // A shared server cannot know all of its names, for example names from a local name server.
        let is_known_host = matches!(self, Self::Tokens(_)) || is_loopback(host);
        if has_same_origin && is_known_host {
            Ok(())
        } else {
            Err(refusal)
        }
    }

    /// The role of a request, from its `Authorization` header or its cookies.
    pub(crate) fn role_of(&self, headers: &HeaderMap) -> Result<Role, Refusal> {
        let Self::Tokens(tokens) = self else {
            return Ok(Role::Operator);
        };
        // A browser sends the cookies of all servers of a computer. Any of them may be the right
        // one.
        let mut refusal = Refusal::NoToken;
        for token in tokens_in(headers) {
            match tokens.role_of(token) {
                Some(role) => return Ok(role),
                None => refusal = Refusal::WrongToken,
            }
        }
        Err(refusal)
    }
}

/// Whether a `Host` header names this computer.
fn is_loopback(host: &str) -> bool {
    // The last colon separates the port, unless it belongs to an IPv6 address without one.
    let name = host
        .rsplit_once(':')
        .filter(|(_, port)| port.parse::<u16>().is_ok())
        .map_or(host, |(name, _)| name);
    let address = name
        .trim_start_matches('[')
        .trim_end_matches(']')
        .parse::<IpAddr>();
    name.eq_ignore_ascii_case("localhost") || address.is_ok_and(|address| address.is_loopback())
}

/// The values of a header, without those that are not text.
fn texts(headers: &HeaderMap, name: HeaderName) -> impl Iterator<Item = &str> {
    headers
        .get_all(name)
        .into_iter()
        .filter_map(|value| value.to_str().ok())
}

/// The tokens in a request.
fn tokens_in(headers: &HeaderMap) -> impl Iterator<Item = &str> {
    let bearer =
        texts(headers, header::AUTHORIZATION).filter_map(|value| value.strip_prefix("Bearer "));
    let cookies = texts(headers, header::COOKIE).flat_map(|value| value.split(';'));
    let from_cookies =
        cookies.filter_map(|cookie| cookie.trim().strip_prefix(COOKIE_PREFIX)?.split_once('='));
    bearer
        .chain(from_cookies.map(|(_, token)| token))
        .map(str::trim)
}

#[cfg(test)]
mod tests {
    use super::{Access, Refusal, Role, Token, Tokens};
    use axum::http::{HeaderMap, HeaderName, HeaderValue, header};

    fn headers(pairs: &[(HeaderName, &str)]) -> HeaderMap {
        pairs
            .iter()
            .map(|(name, value)| (name.clone(), HeaderValue::from_str(value).expect("text")))
            .collect()
    }

    fn host_and_origin(host: &str, origin: Option<&str>) -> HeaderMap {
        let mut pairs = vec![(header::HOST, host)];
        pairs.extend(origin.map(|origin| (header::ORIGIN, origin)));
        headers(&pairs)
    }

    #[test]
    fn foreign_origins_and_hosts_are_rejected() {
        let cases = [
            ("127.0.0.1:7007", None, true),
            ("localhost:8080", Some("http://localhost:8080"), true),
            ("[::1]:7007", Some("http://[::1]:7007"), true),
            ("127.0.0.1:7007", Some("http://example.com"), false),
            ("127.0.0.1:7007", Some("http://127.0.0.1:9999"), false),
            ("127.0.0.1:7007", Some("https://127.0.0.1:7007"), false),
            ("127.0.0.1:7007", Some("null"), false),
            ("example.com:7007", Some("http://example.com:7007"), false),
            ("example.com", None, false),
            ("192.168.0.5:7007", None, false),
        ];
        for (host, origin, expected) in cases {
            let checked = Access::Local.check_origin(&host_and_origin(host, origin));
            assert_eq!(checked.is_ok(), expected, "{host} {origin:?}");
        }
        assert_eq!(
            Access::Local.check_origin(&HeaderMap::new()),
            Err(Refusal::ForeignOrigin)
        );
    }

    #[test]
    fn several_hosts_are_rejected() {
        for access in [
            Access::Local,
            Access::Tokens(Tokens::random().expect("random numbers")),
        ] {
            for second in ["localhost", "example.com"] {
                let hosts = headers(&[(header::HOST, "localhost"), (header::HOST, second)]);
                assert_eq!(access.check_origin(&hosts), Err(Refusal::SeveralHosts));
            }
        }
    }

    #[test]
    fn shared_servers_have_any_host_but_one_origin() {
        let access = Access::Tokens(Tokens::random().expect("random numbers"));
        let cases = [
            ("192.168.0.5:7007", None, true),
            ("robot.local:7007", Some("https://robot.local:7007"), true),
            ("robot.local:7007", Some("http://robot.local:7007"), false),
            ("robot.local:7007", Some("https://robot.local:9999"), false),
            ("robot.local:7007", Some("https://example.com"), false),
            ("robot.local:7007", Some("null"), false),
        ];
        for (host, origin, expected) in cases {
            assert_eq!(
                access.check_origin(&host_and_origin(host, origin)).is_ok(),
                expected,
                "{host} {origin:?}"
            );
        }
        assert_eq!(
            access.check_origin(&HeaderMap::new()),
            Err(Refusal::ForeignPage)
        );
    }

    #[test]
    fn tokens_give_roles() {
        let tokens = Tokens::random().expect("random numbers");
        let (operator, viewer) = (
            tokens.operator.text().to_owned(),
            tokens.viewer.text().to_owned(),
        );
        let access = Access::Tokens(tokens);
        let bearer = |token: &str| headers(&[(header::AUTHORIZATION, &format!("Bearer {token}"))]);
        let cookie = |text: &str| headers(&[(header::COOKIE, text)]);
        assert_eq!(access.role_of(&bearer(&operator)), Ok(Role::Operator));
        assert_eq!(access.role_of(&bearer(&viewer)), Ok(Role::Viewer));
        let other_server =
            format!("theme=dark; __Host-fieldrig-8080=0123; __Host-fieldrig-7007={viewer}");
        assert_eq!(access.role_of(&cookie(&other_server)), Ok(Role::Viewer));
        for wrong in [
            "",
            "0",
            &operator[1..],
            &operator.to_uppercase(),
            &format!("{operator}0"),
            &"f".repeat(32),
        ] {
            assert_eq!(
                access.role_of(&bearer(wrong)),
                Err(Refusal::WrongToken),
                "{wrong}"
            );
        }
        for missing in [
            HeaderMap::new(),
            cookie("theme=dark"),
            cookie(&format!("fieldrig={operator}")),
        ] {
            assert_eq!(access.role_of(&missing), Err(Refusal::NoToken));
        }
        assert_eq!(Access::Local.role_of(&HeaderMap::new()), Ok(Role::Operator));
    }

    #[test]
    fn tokens_are_random_and_hidden_in_logs() {
        let (a, b) = (
            Token::random().expect("a token"),
            Token::random().expect("a token"),
        );
        assert_eq!((a.text().len(), a.text() == b.text()), (32, false));
        assert!(!format!("{a:?}").contains(a.text()));
    }
}
