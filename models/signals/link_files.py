"""Files a Zenoh session needs and nobody else should see: read when it opens, never earlier, never kept."""

import os
import stat
from pathlib import Path

from models.errors import MachineFileError

__all__ = ["check_certificate", "check_key", "read_password", "read_user_names"]


def read_password(field: str, path: Path) -> str:
    """The password that is alone in a file.

    Raises
    ------
    MachineFileError
        If the file cannot be read, others may read it, or it is not one line.
    """
    lines = _secret(field, path).splitlines()
    if len(lines) != 1 or not lines[0].strip():
        raise MachineFileError(f"link.{field}: {path}: expected one line with the password, found {len(lines)} lines")
    return lines[0].strip()


def read_user_names(field: str, path: Path) -> frozenset[str]:
    """Names of the users in a file with a line ``name:password`` for each.

    Raises
    ------
    MachineFileError
        If the file cannot be read, others may read it, or a line is none of these.
    """
    names: list[str] = []
    for number, line in enumerate(_secret(field, path).splitlines(), start=1):
        name, colon, password = line.partition(":")
        if not (name and colon and password) or line != line.strip() or " " in name:
            # Never the line itself: there is a password in it.
            raise MachineFileError(
                f"link.{field}: {path}: line {number}: expected name:password, without spaces around them, "
                "comments or empty lines"
            )
        if name in names:
            raise MachineFileError(f"link.{field}: {path}: line {number}: the user {name} has a line already")
        names.append(name)
    if not names:
        raise MachineFileError(f"link.{field}: {path}: no users, expected a line name:password for each")
    return frozenset(names)


def check_certificate(field: str, path: Path) -> None:
    """Check that a file has a certificate.

    Raises
    ------
    MachineFileError
        If it cannot be read, or is not PEM.
    """
    if "-----BEGIN CERTIFICATE-----" not in _text(field, path):
        raise MachineFileError(f"link.{field}: {path}: expected a certificate in PEM (-----BEGIN CERTIFICATE-----)")


def check_key(field: str, path: Path) -> None:
    """Check that a file has a private key that others may not read.

    Raises
    ------
    MachineFileError
        If it cannot be read, others may read it, it is not PEM, or needs a passphrase.
    """
    text = _secret(field, path)
    if "ENCRYPTED" in text:
        raise MachineFileError(
            f"link.{field}: {path}: the private key needs a passphrase, which nobody is there to enter; expected none"
        )
    if "PRIVATE KEY-----" not in text:
        raise MachineFileError(f"link.{field}: {path}: expected a private key in PEM (-----BEGIN PRIVATE KEY-----)")


def _secret(field: str, path: Path) -> str:
    try:
        mode = stat.S_IMODE(path.stat().st_mode)
    except OSError as error:
        raise MachineFileError(f"link.{field}: {path}: cannot be read ({error.strerror})") from error
    if os.name == "posix" and mode & stat.S_IRWXO:
        raise MachineFileError(
            f"link.{field}: {path}: every user of this computer may read or change it (mode {mode:04o}); "
            f"protect it with: chmod 600 {path}"
        )
    return _text(field, path)


def _text(field: str, path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8")
    except OSError as error:
        raise MachineFileError(f"link.{field}: {path}: cannot be read ({error.strerror})") from error
    except UnicodeDecodeError as error:
        raise MachineFileError(f"link.{field}: {path}: not a text file") from error
