//! The URL of a clip in an object store.

use std::fmt;

use object_store::{ObjectStoreScheme, path::Path};
use url::Url;

use super::RemoteClipError;

/// Where a clip lies in an object store. Holds no credentials, so that it may be shown and stored.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct ClipUrl {
    url: Url,
    scheme: ObjectStoreScheme,
    prefix: Path,
}

/// Whether a clip is given by a URL that is not of this machine.
pub(crate) fn is_remote(clip: &str) -> bool {
    clip.split_once("://").is_some_and(|(scheme, _)| !scheme.eq_ignore_ascii_case("file"))
}

impl ClipUrl {
    pub(crate) fn parse(given: &str) -> Result<Self, RemoteClipError> {
        let refused = |reason: &str, remedy: &'static str| RemoteClipError::Address {
            url: without_secrets(given),
            reason: reason.to_owned(),
            remedy,
        };
        let kinds = "give a path, or a URL with file://, s3://, gs://, az://, abfss://, https:// or http://";
        let url = Url::parse(given).map_err(|error| refused(&format!("is no valid URL ({error})"), kinds))?;
        if url.query().is_some() || url.fragment().is_some() {
            let remedy = "leave out what follows ? or # and give credentials in the coordinator's environment; write \
                          %3F and %23 where they belong to the name";
            return Err(refused("has a query or a fragment", remedy));
        }
        let (scheme, prefix) = ObjectStoreScheme::parse(&url)
            .map_err(|_| refused("is of a kind that is not supported, or its path has '.' or '..'", kinds))?;
        if matches!(scheme, ObjectStoreScheme::Local | ObjectStoreScheme::Memory) {
            return Err(refused("is of a kind that is not supported", kinds));
        }
        // In abfss://container@account.dfs.core.windows.net/ the name before the @ is the container.
        let names_container = scheme == ObjectStoreScheme::MicrosoftAzure && url.scheme() != "https";
        if url.password().is_some() || !(url.username().is_empty() || names_container) {
            let remedy = "leave it out of the URL and give credentials in the coordinator's environment";
            return Err(refused("has a user name or a password", remedy));
        }
        Ok(Self { url, scheme, prefix })
    }

    pub(crate) fn url(&self) -> &Url {
        &self.url
    }

    pub(crate) fn scheme(&self) -> &ObjectStoreScheme {
        &self.scheme
    }

    /// What the names of the clip's objects begin with, inside their bucket.
    pub(crate) fn prefix(&self) -> &Path {
        &self.prefix
    }

    /// Names the folder of the clip's copy: the same for the same place, with or without a slash at its end.
    pub(crate) fn digest(&self) -> String {
        blake3::hash(self.url.as_str().trim_end_matches('/').as_bytes()).to_hex().to_string()
    }
}

impl fmt::Display for ClipUrl {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.url.fmt(formatter)
    }
}

/// A URL for an error, before it is known to hold no credentials: without query and fragment, and not more than its
/// kind where an @ may end a password.
pub(crate) fn without_secrets(given: &str) -> String {
    let Some((scheme, rest)) = given.split_once("://") else { return given.to_owned() };
    if rest.contains('@') {
        return format!("{scheme}://…");
    }
    let end = rest.find(['?', '#']).unwrap_or(rest.len());
    format!("{scheme}://{}", &rest[..end])
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "tests")]

    use super::*;

    #[test]
    fn the_urls_of_object_stores_have_a_prefix() {
        for (given, prefix) in [
            ("s3://bucket/a/clip", "a/clip"),
            ("s3://bucket/a/clip/", "a/clip"),
            ("s3://bucket", ""),
            ("gs://bucket/clip", "clip"),
            ("az://container/clip", "clip"),
            ("abfss://container@account.dfs.core.windows.net/clip", "clip"),
            ("https://host/my%20clip", "my clip"),
            ("http://127.0.0.1:80/clip", "clip"),
        ] {
            assert!(is_remote(given));
            assert_eq!(ClipUrl::parse(given).unwrap().prefix().as_ref(), prefix, "{given}");
        }
        assert!(!is_remote("/clip") && !is_remote("file:///clip"));
        let digest = |url: &str| ClipUrl::parse(url).unwrap().digest();
        assert_eq!(digest("s3://bucket/clip"), digest("s3://bucket/clip/"));
        assert_ne!(digest("s3://bucket/clip"), digest("s3://bucket/clip2"));
    }

    #[test]
    fn urls_with_credentials_are_refused_and_never_repeated() {
        for given in [
            "s3://hunter2@bucket/clip",
            "https://me:hunter2@host/clip",
            "https://me:hun/ter2?@host/clip",
            "abfss://container:hunter2@account.dfs.core.windows.net/clip",
            "https://host/clip?sig=hunter2",
            "https://host/clip?sig=a@hunter2",
            "s3://bucket/clip#hunter2",
            "ftp://me:hunter2@host/clip",
            "s3://:hunter2@/clip",
        ] {
            let error = ClipUrl::parse(given).unwrap_err();
            for text in [error.to_string(), format!("{error:?}")] {
                assert!(!text.contains("ter2"), "{given}: {text}");
                assert!(text.contains("://"), "{given}: {text}");
            }
        }
    }

    #[test]
    fn other_urls_are_refused_with_the_kinds_that_there_are() {
        for given in
            ["ftp://host/clip", "memory:///clip", "s3://", "s3:///clip", "://", "s3://b/../../etc%2F.."]
        {
            match ClipUrl::parse(given) {
                Err(error) => assert!(error.to_string().contains("s3://"), "{given}: {error}"),
                // A URL parser takes plain dots away; what is left stays inside the bucket.
                Ok(url) => assert!(!url.prefix().as_ref().contains(".."), "{given}: {url}"),
            }
        }
    }
}
