"""``keygen``, ``sign`` and ``verify``: who made a controller's file."""

from __future__ import annotations

import argparse
import os
from datetime import UTC, datetime, timedelta
from pathlib import Path

from loopwright.serving.controller_file import contents
from loopwright.serving.errors import SignatureError
from loopwright.serving.words import plain

MAX_PASSWORD = 1023  # bytes, of cryptography
MAX_FILE = 4096  # bytes, of a file with a password


def keygen_options(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of ``keygen``."""
    parser.add_argument("key", metavar="KEY", type=Path, help="the private key's file, such as anna.key")
    parser.add_argument("--kind", choices=("p256", "ed25519"), default="p256", help="%(default)s unless told otherwise")
    _password(parser, "encrypts the key")


def run_keygen(options: argparse.Namespace) -> None:
    """Make a private key and its public key."""
    from loopwright.serving.signing.keys import make_pair

    password = password_of(options.password_env, options.password_file)
    public, key = make_pair(options.key, options.kind, password)
    guarded = "encrypted by the password" if password else "without a password: whoever reads it can sign as you"
    print(f"private key  {options.key} ({guarded}); keep it to yourself")
    print(f"public key   {public}; give it to whoever runs your controllers")
    print(f"fingerprint  {key.fingerprint}")


def sign_options(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of ``sign``."""
    parser.add_argument("files", metavar="FILE", type=Path, nargs="+", help="a controller's .onnx file")
    parser.add_argument("--key", metavar="KEY", type=Path, required=True, help="the private key's file")
    last = parser.add_mutually_exclusive_group()
    last.add_argument("--expires", metavar="DAY", type=_day, help="the last day of the signature, YYYY-MM-DD (UTC)")
    last.add_argument("--days", metavar="N", type=_days, help="the signature's days from now on")
    _password(parser, "opens the key")


def run_sign(options: argparse.Namespace) -> None:
    """Write the signature of each file, beside it."""
    from loopwright.serving.signing.keys import PrivateKey
    from loopwright.serving.signing.sign import sign

    key = PrivateKey.read(options.key, password_of(options.password_env, options.password_file))
    expires = options.expires if options.days is None else datetime.now(UTC).replace(microsecond=0) + options.days
    until = "" if expires is None else f", until {expires:%Y-%m-%d}"
    for file in options.files:
        print(plain(f"{sign(file, key, expires=expires)}: signed by {key.public.words}{until}"))


def verify_options(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of ``verify``."""
    parser.add_argument("file", metavar="FILE", type=Path, help="a controller's .onnx file")
    parser.add_argument(
        "--key", metavar="PUBLIC", type=Path, nargs="+", required=True, help="public keys; one must fit"
    )
    parser.add_argument("--signature", metavar="SIG", type=Path, help="the signature's file (FILE.sig)")


def run_verify(options: argparse.Namespace) -> None:
    """Say who signed a file, or fail."""
    from loopwright.serving.signing.verify import verified

    found = verified(options.file, options.key, signature=options.signature)
    print(plain(f"{' and '.join(found.files)}: signed by {found.words}"))


def password_of(variable: str | None, file: Path | None) -> bytes | None:
    """The password in an environment variable or in the first line of a file; None where neither is named.

    Raises SignatureError where there is none, or it is longer than a key's file can have.
    """
    if variable is not None:
        password, where = os.fsencode(os.environ.get(variable, "")), f"the environment variable {variable}"
    elif file is not None:
        password, where = _first_line(file), f"the first line of {file}"
    else:
        return None
    if not 1 <= len(password) <= MAX_PASSWORD:
        raise SignatureError(f"{where} must hold the key's password, of 1 to {MAX_PASSWORD} bytes")
    return password


def _first_line(file: Path) -> bytes:
    try:
        return (contents(file, MAX_FILE).splitlines() or [b""])[0]
    except FileNotFoundError:
        raise SignatureError(f"{file} does not exist; it should hold the key's password") from None


def _password(parser: argparse.ArgumentParser, what: str) -> None:
    where = parser.add_mutually_exclusive_group()
    where.add_argument("--password-env", metavar="NAME", help=f"environment variable with the password that {what}")
    where.add_argument("--password-file", metavar="FILE", type=Path, help=f"file with the password that {what}")


def _day(text: str) -> datetime:
    """The end of a day."""
    try:
        return datetime.strptime(text, "%Y-%m-%d").replace(hour=23, minute=59, second=59, tzinfo=UTC)
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is no day; write it as 2027-12-31") from None


def _days(text: str) -> timedelta:
    if not text.isdecimal() or not 1 <= int(text) <= 36_500:
        raise argparse.ArgumentTypeError(f"{text!r} is no whole number of days, 1 to 36500")
    return timedelta(days=int(text))
