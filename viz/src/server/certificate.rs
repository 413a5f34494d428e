//! The TLS certificate of a server: self-signed and kept across runs, or the user's own.

use crate::Error;
use rcgen::{
    CertificateParams, DistinguishedName, DnType, ExtendedKeyUsagePurpose, KeyPair, date_time_ymd,
};
use rustls::pki_types::pem::PemObject;
use rustls::pki_types::{CertificateDer, PrivateKeyDer};
use sha2::{Digest, Sha256};
use std::io::{ErrorKind, Write};
use std::path::Path;
use std::sync::Arc;

/// Name of the file with the self-signed certificate and its private key. Both are in one file, so
/// that they always match.
const FILE: &str = "page-certificate.pem";
/// Years of validity. The period is so long because browsers cannot renew their trust in a
/// self-signed certificate, and the clocks of robots may be wrong.
const VALID_YEARS: std::ops::Range<i32> = 2020..2100;

/// A certificate and its private key.
pub struct Certificate {
    chain: Vec<CertificateDer<'static>>,
    key: PrivateKeyDer<'static>,
}

impl std::fmt::Debug for Certificate {
    fn fmt(&self, formatter: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        formatter
            .debug_struct("Certificate")
            .field("fingerprint", &self.fingerprint())
            .finish_non_exhaustive()
    }
}

impl Certificate {
    /// The self-signed certificate in this folder. It is created if the folder has none, so that
    /// browsers need to trust a computer only once.
    pub fn kept_in(folder: &Path) -> Result<Self, Error> {
        let file = folder.join(FILE);
        if !file
            .try_exists()
            .map_err(|source| Error::WriteCertificate {
                file: file.clone(),
                source,
            })?
        {
            let pem = self_signed_pem(&host_name()).map_err(|error| Error::Certificate {
                file: file.clone(),
                reason: error.to_string(),
            })?;
            // Several processes may start at the same time. The first file wins, and all of them
            // read it.
            create(folder, &file, &pem).map_err(|source| Error::WriteCertificate {
                file: file.clone(),
                source,
            })?;
        }
        // The check is stricter than for files of users, because nobody else needs a key that this
        // program has made.
        check_is_private(&file, GROUP_AND_OTHERS)?;
        Self::read(&file, &file)
    }

    /// Reads a certificate with its chain, and its private key, from PEM files. They may be the
    /// same file. A key that every user can read is refused. A group may read the key, because keys
    /// that several programs use are often readable by a group.
    pub fn read(certificate_file: &Path, key_file: &Path) -> Result<Self, Error> {
        let failed = |file: &Path, error: &dyn std::fmt::Display| Error::Certificate {
            file: file.to_owned(),
            reason: error.to_string(),
        };
        let read = |file: &Path| {
            files::read(file, files::Budget::TEXT).map_err(|error| failed(file, &error))
        };
        let chain = CertificateDer::pem_slice_iter(&read(certificate_file)?)
            .collect::<Result<Vec<_>, _>>()
            .map_err(|error| failed(certificate_file, &error))?;
        if chain.is_empty() {
            return Err(failed(
                certificate_file,
                &"it contains no certificate in PEM format",
            ));
        }
        check_is_private(key_file, OTHERS)?;
        let key = PrivateKeyDer::from_pem_slice(&read(key_file)?)
            .map_err(|error| failed(key_file, &error))?;
        let certificate = Self { chain, key };
        // A key of another certificate is detected here, and not only when the first client
        // connects.
        certificate
            .server_config()
            .map_err(|error| failed(certificate_file, &error))?;
        Ok(certificate)
    }

    /// SHA-256 of the certificate as browsers display it, such as `AB:CD:...`.
    pub fn fingerprint(&self) -> String {
        let digest = Sha256::digest(&self.chain[0]);
        digest
            .iter()
            .map(|byte| format!("{byte:02X}"))
            .collect::<Vec<_>>()
            .join(":")
    }

    /// The TLS settings of a server with this certificate: TLS 1.3, HTTP/1.1.
    pub(crate) fn server_config(&self) -> Result<Arc<rustls::ServerConfig>, rustls::Error> {
        let provider = Arc::new(rustls::crypto::ring::default_provider());
        let mut config = rustls::ServerConfig::builder_with_provider(provider)
            .with_safe_default_protocol_versions()?
            .with_no_client_auth()
            .with_single_cert(self.chain.clone(), self.key.clone_key())?;
        // WebSockets over HTTP/2 would need another handshake, so browsers must use HTTP/1.1.
        config.alpn_protocols = vec![b"http/1.1".to_vec()];
        Ok(Arc::new(config))
    }
}

/// A new certificate for this computer and its private key.
fn self_signed_pem(host_name: &str) -> Result<String, rcgen::Error> {
    // Computers may have names that are invalid in certificates, for example with underscores.
    let is_dns_name = !host_name.is_empty()
        && host_name
            .chars()
            .all(|c| c.is_ascii_alphanumeric() || "-.".contains(c));
    let mut names = vec![
        "localhost".to_owned(),
        "127.0.0.1".to_owned(),
        "::1".to_owned(),
    ];
    if is_dns_name {
        // `.local` is the name in the local network (multicast DNS).
        names.extend([host_name.to_owned(), format!("{host_name}.local")]);
    }
    let mut params = CertificateParams::new(names)?;
    params.distinguished_name = DistinguishedName::new();
    params
        .distinguished_name
        .push(DnType::CommonName, "fieldrig");
    params.extended_key_usages = vec![ExtendedKeyUsagePurpose::ServerAuth];
    params.not_before = date_time_ymd(VALID_YEARS.start, 1, 1);
    params.not_after = date_time_ymd(VALID_YEARS.end, 1, 1);
    let key = KeyPair::generate()?;
    Ok(params.self_signed(&key)?.pem() + &key.serialize_pem())
}

#[cfg(unix)]
fn host_name() -> String {
    rustix::system::uname()
        .nodename()
        .to_string_lossy()
        .into_owned()
}

#[cfg(not(unix))]
fn host_name() -> String {
    String::new()
}

/// Creates the file as a whole, readable only by this user. Another process may create it first.
fn create(folder: &Path, file: &Path, pem: &str) -> std::io::Result<()> {
    let mut builder = std::fs::DirBuilder::new();
    #[cfg(unix)]
    std::os::unix::fs::DirBuilderExt::mode(&mut builder, 0o700);
    builder.recursive(true).create(folder)?;
    // Created with mode 0600. The name appears only when the file is complete, because another
    // process may read it at any time.
    let mut temporary = tempfile::NamedTempFile::new_in(folder)?;
    temporary.write_all(pem.as_bytes())?;
    // Otherwise, a power failure could leave an empty file, which would have to be deleted by hand.
    temporary.as_file().sync_all()?;
    // A browser may trust the existing file already, so it is never replaced.
    match temporary.persist_noclobber(file) {
        Err(error) if error.error.kind() != ErrorKind::AlreadyExists => Err(error.error),
        _ => Ok(()),
    }
}

/// Permissions of the group and of all other users.
const GROUP_AND_OTHERS: u32 = 0o077;
/// Permissions of all other users.
const OTHERS: u32 = 0o007;

#[cfg(unix)]
fn check_is_private(file: &Path, forbidden: u32) -> Result<(), Error> {
    use std::os::unix::fs::PermissionsExt;
    let metadata = file.metadata().map_err(|error| Error::Certificate {
        file: file.to_owned(),
        reason: error.to_string(),
    })?;
    if metadata.permissions().mode() & forbidden == 0 {
        Ok(())
    } else {
        Err(Error::PublicKeyFile {
            file: file.to_owned(),
        })
    }
}

#[cfg(not(unix))]
fn check_is_private(_: &Path, _: u32) -> Result<(), Error> {
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::{Certificate, FILE};
    use crate::Error;
    use std::os::unix::fs::PermissionsExt;

    #[test]
    fn certificate_is_kept_and_private() {
        let root = tempfile::tempdir().expect("a folder");
        let folder = root.path().join("fieldrig");
        let first = Certificate::kept_in(&folder)
            .expect("created")
            .fingerprint();
        assert_eq!(
            Certificate::kept_in(&folder).expect("read").fingerprint(),
            first
        );
        assert_eq!((first.len(), first.split(':').count()), (95, 32), "{first}");
        let mode = |path: &std::path::Path| {
            path.metadata().expect("it exists").permissions().mode() & 0o777
        };
        assert_eq!((mode(&folder), mode(&folder.join(FILE))), (0o700, 0o600));
        assert_eq!(
            folder.read_dir().expect("a folder").count(),
            1,
            "no temporary files remain"
        );
        let other = Certificate::kept_in(&root.path().join("other"))
            .expect("created")
            .fingerprint();
        assert_ne!(other, first);
    }

    #[test]
    fn all_processes_get_the_same_certificate() {
        let root = tempfile::tempdir().expect("a folder");
        let fingerprint = || {
            Certificate::kept_in(root.path())
                .expect("created")
                .fingerprint()
        };
        let fingerprints: Vec<_> = std::thread::scope(|scope| {
            let threads: Vec<_> = (0..8).map(|_| scope.spawn(fingerprint)).collect();
            threads
                .into_iter()
                .map(|thread| thread.join().expect("no panic"))
                .collect()
        });
        assert!(
            fingerprints.iter().all(|other| *other == fingerprints[0]),
            "{fingerprints:?}"
        );
    }

    #[test]
    fn unusable_files_are_named() {
        let root = tempfile::tempdir().expect("a folder");
        for name in ["a", "b"] {
            Certificate::kept_in(&root.path().join(name)).expect("created");
        }
        let [a, b] = ["a", "b"].map(|name| root.path().join(name).join(FILE));
        Certificate::read(&a, &a).expect("its own key");
        let garbage = root.path().join("garbage");
        // Only the permissions of a key matter.
        std::fs::write(
            &garbage,
            "-----BEGIN CERTIFICATE-----\n!!\n-----END CERTIFICATE-----\n",
        )
        .expect("written");
        for (certificate, key, named) in [
            (&a, &b, &a),
            (&garbage, &a, &garbage),
            (&a, &garbage, &garbage),
            (&root.path().join("c"), &a, &root.path().join("c")),
        ] {
            let error = Certificate::read(certificate, key)
                .expect_err("unusable")
                .to_string();
            assert!(
                error.contains(&named.display().to_string()) && !error.contains('\n'),
                "{error}"
            );
        }
        let set_mode = |mode| {
            std::fs::set_permissions(&b, std::fs::Permissions::from_mode(mode)).expect("permitted")
        };
        set_mode(0o640);
        Certificate::read(&b, &b).expect("a group may read the key of the user");
        set_mode(0o644);
        let error = Certificate::read(&b, &b).expect_err("everybody can read the key");
        assert!(matches!(error, Error::PublicKeyFile { .. }), "{error}");
        set_mode(0o640);
        let error =
            Certificate::kept_in(b.parent().expect("a folder")).expect_err("readable by the group");
        assert!(
            matches!(error, Error::PublicKeyFile { .. }) && error.to_string().contains("chmod 600"),
            "{error}"
        );
    }
}
