//! Access control of the viewer, and security headers of its responses.

use std::net::IpAddr;
use std::sync::Arc;

use axum::extract::{Request, State};
use axum::http::header::{self, HeaderMap, HeaderValue};
use axum::http::uri::Authority;
use axum::http::{StatusCode, Uri};
use axum::middleware::Next;
use axum::response::{IntoResponse, Response};
use serde::Deserialize;

use super::served::Served;

/// Allows resources of this server only, and no embedding in other pages.
const POLICY: &str = "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' blob: data:; \
                      connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'";

/// Refuses requests with foreign host names, which prevents DNS rebinding. Also refuses requests from pages of other
/// origins.
pub async fn check_access(State(served): State<Arc<Served>>, request: Request, next: Next) -> Response {
    let refused = refusal(request.headers(), &served.host);
    let mut response = match refused {
        Some(refused) => refused.into_response(),
        None => next.run(request).await,
    };
    let headers = response.headers_mut();
    for (name, value) in [
        (header::CONTENT_SECURITY_POLICY, POLICY),
        (header::X_CONTENT_TYPE_OPTIONS, "nosniff"),
        (header::X_FRAME_OPTIONS, "DENY"),
        (header::REFERRER_POLICY, "no-referrer"),
        (header::CACHE_CONTROL, "no-store"),
    ] {
        headers.insert(name, HeaderValue::from_static(value));
    }
    headers.insert("cross-origin-resource-policy", HeaderValue::from_static("same-origin"));
    response
}

/// The error response for a request, if it is refused.
fn refusal(headers: &HeaderMap, own: &str) -> Option<(StatusCode, &'static str)> {
    let text = |name| headers.get(name).map(|value: &HeaderValue| value.to_str().unwrap_or_default());
    let host = text(header::HOST).unwrap_or_default();
    if !is_own(host, own) {
        let what = "Unknown host name. Open the printed address, or restart with --host NAME.\n";
        return Some((StatusCode::MISDIRECTED_REQUEST, what));
    }
    let foreign = text(header::ORIGIN).is_some_and(|origin| !is_same(origin, host));
    foreign.then_some((StatusCode::FORBIDDEN, "Requests from other sites are not allowed.\n"))
}

/// Returns true if a `Host` is an IP address or a name of this machine. DNS cannot redirect addresses.
fn is_own(host: &str, own: &str) -> bool {
    let Ok(authority) = host.parse::<Authority>() else { return false };
    let name = authority.host().trim_start_matches('[').trim_end_matches(']');
    !authority.as_str().contains('@')
        && (name.parse::<IpAddr>().is_ok()
            || name.eq_ignore_ascii_case("localhost")
            || (!own.is_empty() && name.eq_ignore_ascii_case(own)))
}

/// Returns true if an `Origin` is this server's.
fn is_same(origin: &str, host: &str) -> bool {
    origin
        .parse::<Uri>()
        .is_ok_and(|origin| origin.authority().is_some_and(|authority| authority.as_str().eq_ignore_ascii_case(host)))
}

/// The token in the query of a page's request.
#[derive(Deserialize)]
pub struct AccessToken {
    token: Option<String>,
}

impl AccessToken {
    /// Returns true if the token is the server's.
    pub fn opens(&self, token: &str) -> bool {
        self.token.as_deref().is_some_and(|given| is_equal(given, token))
    }
}

/// Compares texts in constant time.
fn is_equal(a: &str, b: &str) -> bool {
    a.len() == b.len() && a.bytes().zip(b.bytes()).fold(0, |apart, (a, b)| apart | (a ^ b)) == 0
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn host_accepts_addresses_and_own_names_only() {
        for host in
            ["127.0.0.1:7007", "127.0.0.1", "[::1]:80", "localhost:7007", "LOCALHOST", "192.168.1.9:1", "box.lan:7007"]
        {
            assert!(is_own(host, "box.lan"), "{host}");
        }
        for host in [
            "",
            ":80",
            "evil.example",
            "evil.example:7007",
            "localhost.evil.example",
            "127.0.0.1.nip.io",
            "a@127.0.0.1",
            "::1",
            "a b",
        ] {
            assert!(!is_own(host, "box.lan"), "{host}");
        }
        assert!(!is_own("box.lan", "0.0.0.0") && !is_own("", "") && !is_own(":80", ""));
    }

    #[test]
    fn origin_of_other_sites_is_refused() {
        assert!(is_same("http://127.0.0.1:7007", "127.0.0.1:7007") && is_same("https://box.lan", "box.lan"));
        for origin in [
            "null",
            "",
            "http://127.0.0.1:7008",
            "http://evil.example",
            "file://",
            "http://127.0.0.1:7007.evil.example",
        ] {
            assert!(!is_same(origin, "127.0.0.1:7007"), "{origin}");
        }
    }

    #[test]
    fn token_other_than_the_own_is_refused() {
        let opens = |given: Option<&str>| AccessToken { token: given.map(str::to_owned) }.opens("abc");
        assert!(opens(Some("abc")));
        // No token, other lengths, and differences that cancel each other in a sum.
        for given in [None, Some(""), Some("ab"), Some("abcd"), Some("abd"), Some("ABC"), Some("bac"), Some("cba")] {
            assert!(!opens(given), "{given:?}");
        }
    }
}
