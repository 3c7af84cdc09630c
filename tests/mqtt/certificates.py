"""Certificate authority for tests, by openssl."""

import subprocess
from pathlib import Path

EC_KEY = ["-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:prime256v1", "-nodes"]
SUBJECT_ALT_NAMES = "subjectAltName=IP:127.0.0.1,DNS:localhost"


def openssl(*arguments: str | Path) -> None:
    """Run openssl. Raise an exception if it fails."""
    subprocess.run(["openssl", *arguments], check=True, capture_output=True)


class Authority:
    """Certificate authority whose files are in a folder.

    Attributes:
        certificate: Path of the authority's own certificate.
    """

    def __init__(self, folder: Path, name: str = "ca") -> None:
        self._folder = folder
        self.certificate, self._key = folder / f"{name}.crt", folder / f"{name}.key"
        openssl(
            "req", "-x509", *EC_KEY, "-keyout", self._key, "-out", self.certificate, "-days", "2", "-subj", "/CN=CA"
        )

    def sign(self, name: str) -> tuple[Path, Path]:
        """Create a certificate and a key for a server or client on this machine. Return the paths of both."""
        certificate, key, request = (self._folder / f"{name}.{suffix}" for suffix in ("crt", "key", "csr"))
        extensions = self._folder / "extensions"
        extensions.write_text(SUBJECT_ALT_NAMES)
        openssl("req", *EC_KEY, "-keyout", key, "-out", request, "-subj", f"/CN={name}")
        openssl("x509", "-req", "-in", request, "-CA", self.certificate, "-CAkey", self._key, "-CAcreateserial",
                "-out", certificate, "-days", "2", "-extfile", extensions)  # fmt: skip
        key.chmod(0o600)
        return certificate, key
