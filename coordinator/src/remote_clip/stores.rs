//! Object stores, and what they say when they refuse.

use std::{error::Error, fmt, str::FromStr, sync::Arc, time::Duration};

use object_store::{
    BackoffConfig, ClientOptions, ObjectStore, ObjectStoreScheme, RetryConfig,
    aws::{AmazonS3Builder, AmazonS3ConfigKey},
    azure::{AzureConfigKey, MicrosoftAzureBuilder},
    gcp::{GoogleCloudStorageBuilder, GoogleConfigKey},
    http::HttpBuilder,
};

use super::{ClipUrl, RemoteClipError};

/// A silent connection counts as lost after this; a transfer may take as long as it moves.
const READ_TIMEOUT: Duration = Duration::from_secs(30);
/// Attempts at one request after the first.
const RETRIES: usize = 6;
/// Pause before the first of them; later ones are longer, some ten seconds together.
const FIRST_PAUSE: Duration = Duration::from_millis(500);
/// No further attempt at a request after this.
const RETRY_TIMEOUT: Duration = Duration::from_secs(60);
/// Longest cause that an error repeats from a server, in characters.
const LONGEST_CAUSE: usize = 300;

/// How object stores are reached: credentials, endpoints, regions, by the usual names of environment variables.
#[derive(Clone, Default)]
pub struct StoreOptions {
    variables: Vec<(String, String)>,
}

impl StoreOptions {
    /// Keeps of an environment what object stores are configured by: `AWS_*`, `GOOGLE_*` and `AZURE_*`.
    pub fn from_variables(variables: impl IntoIterator<Item = (String, String)>) -> Self {
        let is_ours = |name: &str| ["AWS_", "GOOGLE_", "AZURE_"].iter().any(|kind| name.starts_with(kind));
        let variables =
            variables.into_iter().filter(|(name, value)| is_ours(name) && !value.is_empty()).collect();
        Self { variables }
    }

    /// Applies to a store's builder the variables that it knows.
    fn apply<B, K: FromStr>(&self, kind: &str, builder: B, set: impl Fn(B, K, &str) -> B) -> B {
        let ours = self.variables.iter().filter(|(name, _)| name.starts_with(kind));
        let known = ours.filter_map(|(name, value)| Some((name.to_ascii_lowercase().parse().ok()?, value)));
        known.fold(builder, |builder, (key, value)| set(builder, key, value))
    }

    /// Values that must not be shown.
    fn secrets(&self) -> impl Iterator<Item = &str> {
        let kinds = ["KEY", "SECRET", "TOKEN", "PASSWORD", "SAS"];
        let is_secret = move |name: &str| kinds.iter().any(|kind| name.contains(kind));
        self.variables.iter().filter(move |(name, _)| is_secret(name)).map(|(_, value)| value.as_str())
    }
}

impl fmt::Debug for StoreOptions {
    /// Names only: the values are credentials.
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        formatter.debug_set().entries(self.variables.iter().map(|(name, _)| name)).finish()
    }
}

/// The store that a URL names; nothing is asked of it yet.
pub(super) fn open(url: &ClipUrl, options: &StoreOptions) -> object_store::Result<Arc<dyn ObjectStore>> {
    // TLS needs one provider per process. One that the program has chosen stays.
    let _ = rustls::crypto::ring::default_provider().install_default();
    let client = ClientOptions::new().with_timeout_disabled().with_read_timeout(READ_TIMEOUT);
    let backoff = BackoffConfig { init_backoff: FIRST_PAUSE, ..BackoffConfig::default() };
    let retry = RetryConfig { backoff, max_retries: RETRIES, retry_timeout: RETRY_TIMEOUT };
    let address = url.url().as_str();
    Ok(match url.scheme() {
        ObjectStoreScheme::AmazonS3 => {
            let builder = AmazonS3Builder::new().with_client_options(client).with_retry(retry);
            let set = |builder: AmazonS3Builder, key: AmazonS3ConfigKey, value: &str| {
                builder.with_config(key, value)
            };
            Arc::new(options.apply("AWS_", builder, set).with_url(address).build()?)
        }
        ObjectStoreScheme::GoogleCloudStorage => {
            let builder = GoogleCloudStorageBuilder::new().with_client_options(client).with_retry(retry);
            let set = |builder: GoogleCloudStorageBuilder, key: GoogleConfigKey, value: &str| {
                builder.with_config(key, value)
            };
            Arc::new(options.apply("GOOGLE_", builder, set).with_url(address).build()?)
        }
        ObjectStoreScheme::MicrosoftAzure => {
            let builder = MicrosoftAzureBuilder::new().with_client_options(client).with_retry(retry);
            let set = |builder: MicrosoftAzureBuilder, key: AzureConfigKey, value: &str| {
                builder.with_config(key, value)
            };
            Arc::new(options.apply("AZURE_", builder, set).with_url(address).build()?)
        }
        // Others than HTTP are refused with the URL.
        _ => {
            let client = client.with_allow_http(url.url().scheme() == "http");
            let server = &url.url()[..url::Position::BeforePath];
            let builder = HttpBuilder::new().with_client_options(client).with_retry(retry);
            Arc::new(builder.with_url(server).build()?)
        }
    })
}

/// A store's refusal with its cause and remedy, without what may be a secret.
pub(super) fn refused(url: &ClipUrl, options: &StoreOptions, error: &object_store::Error) -> RemoteClipError {
    let whole = error.to_string();
    let asked_machine = ["169.254.169.254", "metadata.google.internal"].iter().any(|at| whole.contains(at));
    if asked_machine {
        return RemoteClipError::Store {
            url: url.to_string(),
            cause: "no credentials: the environment holds none, and the machine has no metadata service"
                .into(),
            remedy: credentials_remedy(url.scheme()),
            may_pass: false,
        };
    }
    let cause = cause(error, options);
    let is_about = |words: &[&str]| words.iter().any(|word| cause.contains(word));
    let (remedy, may_pass) = if is_about(&["401 ", "403 "]) {
        (credentials_remedy(url.scheme()), false)
    } else if is_about(&["404 "]) {
        ("check the bucket, its region, and the endpoint of the service", false)
    } else if is_about(&["405 ", "501 "]) && *url.scheme() == ObjectStoreScheme::Http {
        (
            "http:// and https:// need a WebDAV server, which lists its folders; give a path or another store",
            false,
        )
    } else if matches!(error, object_store::Error::InvalidPath { .. }) {
        ("rename or remove the object", false)
    } else {
        ("check region, endpoint and network, then submit again: what was copied is kept", true)
    };
    RemoteClipError::Store { url: url.to_string(), cause, remedy, may_pass }
}

fn credentials_remedy(scheme: &ObjectStoreScheme) -> &'static str {
    match scheme {
        ObjectStoreScheme::AmazonS3 => {
            "set AWS_ACCESS_KEY_ID and AWS_SECRET_ACCESS_KEY (or AWS_SKIP_SIGNATURE=true for a public bucket), AWS_REGION \
             and, for another service than Amazon's, AWS_ENDPOINT_URL in the coordinator's environment"
        }
        ObjectStoreScheme::GoogleCloudStorage => {
            "set GOOGLE_APPLICATION_CREDENTIALS to a key file (or GOOGLE_SKIP_SIGNATURE=true for a public bucket) in the \
             coordinator's environment"
        }
        ObjectStoreScheme::MicrosoftAzure => {
            "set AZURE_STORAGE_ACCOUNT_NAME and AZURE_STORAGE_ACCOUNT_KEY (or AZURE_SKIP_SIGNATURE=true for a public \
             container) in the coordinator's environment"
        }
        _ => "give a server that needs no credentials, or a path or another store",
    }
}

/// The innermost reason. The layers around it name addresses whose query may be a signature, and the body of an answer
/// may repeat keys: of it, only the error's code is told.
fn cause(error: &object_store::Error, options: &StoreOptions) -> String {
    let mut innermost: &dyn Error = error;
    while let Some(source) = innermost.source() {
        innermost = source;
    }
    let text = innermost.to_string();
    let said = if let Some(answer) = text.strip_prefix("Server returned non-2xx status code: ") {
        let status = answer.split(':').next().unwrap_or_default();
        match code(answer) {
            Some(code) => format!("{status} ({code})"),
            None => status.to_owned(),
        }
    } else if text.starts_with("Server returned error response") {
        format!("the server failed ({})", code(&text).unwrap_or("no code"))
    } else {
        text
    };
    scrubbed(&said, options)
}

/// `NoSuchBucket` of `<Error><Code>NoSuchBucket</Code>…`.
fn code(answer: &str) -> Option<&str> {
    let code = answer.split_once("<Code>")?.1.split_once("</Code>")?.0;
    let is_plain = !code.is_empty() && code.len() <= 64 && code.chars().all(|c| c.is_ascii_alphanumeric());
    is_plain.then_some(code)
}

fn scrubbed(text: &str, options: &StoreOptions) -> String {
    let mut text = text.to_owned();
    for secret in options.secrets() {
        text = text.replace(secret, "…");
    }
    let words = text.split_whitespace().map(|word| match word.split_once('?') {
        Some((address, _)) if address.contains("://") => address,
        _ => word,
    });
    let text = words.collect::<Vec<_>>().join(" ");
    match text.char_indices().nth(LONGEST_CAUSE) {
        Some((end, _)) => format!("{}…", &text[..end]),
        None => text,
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "tests")]

    use super::*;

    fn options() -> StoreOptions {
        let variables = [
            ("AWS_SECRET_ACCESS_KEY", "hunter2"),
            ("AWS_REGION", "eu-central-1"),
            ("AWS_ENDPOINT_URL", ""),
            ("PATH", "/bin"),
        ];
        StoreOptions::from_variables(variables.map(|(name, value)| (name.to_owned(), value.to_owned())))
    }

    #[test]
    fn options_show_their_names_only() {
        assert_eq!(format!("{:?}", options()), r#"{"AWS_SECRET_ACCESS_KEY", "AWS_REGION"}"#);
    }

    #[test]
    fn every_kind_of_store_opens_with_the_options_of_its_kind() {
        let variables = [
            ("AWS_REGION", "eu-central-1"),
            ("AWS_NOT_AN_OPTION", "x"),
            ("AWS_SKIP_SIGNATURE", "true"),
            ("GOOGLE_SKIP_SIGNATURE", "true"),
            ("AZURE_STORAGE_ACCOUNT_NAME", "account"),
            ("AZURE_SKIP_SIGNATURE", "true"),
        ];
        let options =
            StoreOptions::from_variables(variables.map(|(name, value)| (name.to_owned(), value.to_owned())));
        for (url, name) in [
            ("s3://bucket/clip", "AmazonS3(bucket)"),
            ("gs://bucket/clip", "GoogleCloudStorage(bucket)"),
            ("az://container/clip", "MicrosoftAzure { account: account, container: container }"),
            (
                "abfss://box@mine.dfs.core.windows.net/clip",
                "MicrosoftAzure { account: mine, container: box }",
            ),
            ("https://host/clip", "HttpStore"),
        ] {
            let store = open(&ClipUrl::parse(url).unwrap(), &options).unwrap();
            assert_eq!(store.to_string(), name, "{url}");
        }
    }

    #[test]
    fn errors_hold_no_secret() {
        #[derive(Debug)]
        struct Says(&'static str);
        impl fmt::Display for Says {
            fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
                formatter.write_str(self.0)
            }
        }
        impl Error for Says {}
        let url = ClipUrl::parse("s3://bucket/clip").unwrap();
        let said = |text| {
            let error = object_store::Error::Generic { store: "S3", source: Box::new(Says(text)) };
            refused(&url, &options(), &error).to_string()
        };
        let denied = said(
            "Server returned non-2xx status code: 403 Forbidden: <Error><Code>SignatureDoesNotMatch</Code>\
             <SignatureProvided>hunter3</SignatureProvided></Error>",
        );
        assert!(denied.contains("s3://bucket/clip: 403 Forbidden (SignatureDoesNotMatch)"), "{denied}");
        assert!(denied.contains("AWS_SECRET_ACCESS_KEY") && !denied.contains("hunter"), "{denied}");
        let lost = said("no route to https://host/x?sig=abc with hunter2");
        assert!(lost.contains("no route to https://host/x with …;"), "{lost}");
        assert!(said("Error performing GET http://169.254.169.254/x").contains("no credentials"));
    }
}
