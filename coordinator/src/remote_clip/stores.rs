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
            // A machine's own credentials come by plain HTTP.
            let client = client.with_allow_http(true);
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
    let is_http = *url.scheme() == ObjectStoreScheme::Http;
    let is_status = |statuses: &[&str]| statuses.iter().any(|status| cause.starts_with(status));
    let (remedy, may_pass) = if is_status(&["403 "]) && is_http {
        (
            "the server must let everybody read the clip and list its folders: PROPFIND with Depth infinity; give a path or \
             another store if it cannot",
            false,
        )
    } else if is_status(&["401 ", "403 "]) {
        (credentials_remedy(url.scheme()), false)
    } else if is_status(&["404 "]) {
        ("check the bucket, its region, and the endpoint of the service", false)
    } else if is_status(&["405 ", "501 "]) && is_http {
        (
            "http:// and https:// need a WebDAV server, which lists its folders; give a path or another store",
            false,
        )
    } else if is_status(&["400 ", "301 ", "302 ", "307 ", "308 ", "Received redirect"]) {
        ("check credentials, region and endpoint in the coordinator's environment", false)
    } else if cause.contains("scheme is not allowed") {
        (
            "give an endpoint with https://, or set AWS_ALLOW_HTTP=true (for Azure AZURE_ALLOW_HTTP=true) in the \
             coordinator's environment",
            false,
        )
    } else if matches!(error, object_store::Error::InvalidPath { .. }) {
        ("rename or remove the object", false)
    } else {
        ("check region, endpoint and network, then submit again: what was copied is kept", true)
    };
    RemoteClipError::Store { url: url.to_string(), cause, remedy, may_pass }
}

/// Why a store could not even be set up. The environment or the URL is at fault: it will not pass.
pub(super) fn unopened(
    url: &ClipUrl,
    options: &StoreOptions,
    error: &object_store::Error,
) -> RemoteClipError {
    let (innermost, around) = innermost(error);
    // The system names no file; who opened it does.
    let said = if innermost.is::<std::io::Error>() { around } else { innermost };
    RemoteClipError::Store {
        url: url.to_string(),
        cause: scrubbed(&said.to_string(), options),
        remedy: credentials_remedy(url.scheme()),
        may_pass: false,
    }
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
    let text = innermost(error).0.to_string();
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

/// The innermost error and the one around it.
fn innermost(error: &object_store::Error) -> (&(dyn Error + 'static), &(dyn Error + 'static)) {
    let (mut innermost, mut around): (&(dyn Error + 'static), &(dyn Error + 'static)) = (error, error);
    while let Some(source) = innermost.source() {
        (innermost, around) = (source, innermost);
    }
    (innermost, around)
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
        let answered = |url: &str, text| {
            let error = object_store::Error::Generic { store: "x", source: Box::new(Says(text)) };
            match refused(&ClipUrl::parse(url).unwrap(), &options(), &error) {
                RemoteClipError::Store { remedy, may_pass, .. } => (remedy, may_pass),
                other => panic!("{other:?}"),
            }
        };
        let forbidden = answered("https://host/clip", "Server returned non-2xx status code: 403 Forbidden: ");
        assert!(forbidden.0.contains("PROPFIND with Depth infinity") && !forbidden.1, "{forbidden:?}");
        for text in [
            "Server returned non-2xx status code: 400 Bad Request: ",
            "Received redirect without LOCATION, this normally indicates an incorrectly configured region",
        ] {
            let answer = answered("s3://bucket/clip", text);
            assert!(answer.0.contains("region") && !answer.1, "{text}: {answer:?}");
        }
        assert!(answered("s3://bucket/clip", "connection reset").1);
    }

    fn store_error(error: RemoteClipError) -> (String, bool) {
        match &error {
            RemoteClipError::Store { may_pass, .. } => (error.to_string(), *may_pass),
            other => panic!("{other:?}"),
        }
    }

    #[test]
    fn a_store_that_cannot_be_set_up_names_what_is_missing_and_does_not_pass() {
        let unopened = |url: &str, variables: &[(&str, &str)]| {
            let variables = variables.iter().map(|(name, value)| ((*name).to_owned(), (*value).to_owned()));
            let (url, options) = (ClipUrl::parse(url).unwrap(), StoreOptions::from_variables(variables));
            let error = open(&url, &options).unwrap_err();
            store_error(unopened(&url, &options, &error))
        };
        let (said, may_pass) =
            unopened("gs://bucket/clip", &[("GOOGLE_APPLICATION_CREDENTIALS", "/nowhere/key.json")]);
        assert!(said.contains("/nowhere/key.json") && !may_pass, "{said}");
        let (said, may_pass) = unopened("az://container/clip", &[]);
        assert!(said.contains("AZURE_STORAGE_ACCOUNT_NAME") && !may_pass, "{said}");
    }

    #[tokio::test]
    async fn an_endpoint_without_tls_has_to_be_allowed() {
        use object_store::ObjectStore as _;
        let variables = [
            ("AWS_ENDPOINT_URL", "http://127.0.0.1:9"),
            ("AWS_SKIP_SIGNATURE", "true"),
            ("AWS_REGION", "us-east-1"),
        ];
        let options =
            StoreOptions::from_variables(variables.map(|(name, value)| (name.to_owned(), value.to_owned())));
        let url = ClipUrl::parse("s3://bucket/clip").unwrap();
        let store = open(&url, &options).unwrap();
        let error = store.list_with_delimiter(None).await.unwrap_err();
        let (said, may_pass) = store_error(refused(&url, &options, &error));
        assert!(said.contains("AWS_ALLOW_HTTP=true") && !may_pass, "{said}");
    }
}
