"""Signatures of registered controllers: made by ``publish`` where a key is configured, verified by ``fetch``.

The key is configured by the environment, as the store is: params.yaml is committed, and a key's place is not.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING

from mlflow import MlflowClient

from loopwright.pipeline.errors import TrackingError
from loopwright.serving.signing.command import password_of

if TYPE_CHECKING:
    from loopwright.serving.signing.keys import PrivateKey

KEY = "LOOPWRIGHT_SIGNING_KEY"
PASSWORD, PASSWORD_FILE = "LOOPWRIGHT_SIGNING_PASSWORD", "LOOPWRIGHT_SIGNING_PASSWORD_FILE"
DAYS = "LOOPWRIGHT_SIGNING_DAYS"
TRUSTED = "LOOPWRIGHT_TRUSTED"
BY, FINGERPRINT, UNTIL = "signed_by", "signed_key", "signed_until"
FOR_EVER = "not said"
_LONGEST = 36_500  # days


@dataclass(frozen=True, slots=True)
class Signer:
    """Signer of published versions, and for how long (None: for ever)."""

    key: PrivateKey
    lasting: timedelta | None

    @classmethod
    def configured(cls, environment: Mapping[str, str] = os.environ) -> Signer | None:
        """The signer that the environment names; None where it names no key.

        Raises SignatureError for a key that cannot be used, TrackingError for a number of days that is none.
        """
        place = environment.get(KEY)
        if not place:
            return None
        from loopwright.serving.signing.keys import PrivateKey  # here: it needs the package cryptography

        days = environment.get(DAYS, "")
        if days and not (days.isdecimal() and 1 <= int(days) <= _LONGEST):
            raise TrackingError(f"{DAYS} is {days!r}; it must be a whole number of days, 1 to {_LONGEST}, or unset")
        file = environment.get(PASSWORD_FILE)
        password = password_of(PASSWORD if environment.get(PASSWORD) else None, Path(file) if file else None)
        return cls(PrivateKey.read(place, password), timedelta(days=int(days)) if days else None)

    def attach(self, client: MlflowClient, run_id: str, path: Path, known: Mapping[str, str]) -> dict[str, str]:
        """Store a signature beside the controller in its run; the tags of its version that say so.

        ``known`` are the version's tags: a signature by the same key is kept until half of its time is over.
        """
        if self._holds(known):
            return present(known)
        from loopwright.serving.signing.sign import sign

        now = datetime.now(UTC).replace(microsecond=0)
        expires = None if self.lasting is None else now + self.lasting
        with TemporaryDirectory() as draft:
            for file in (path, path.with_suffix(".json")):
                if file.exists():
                    shutil.copy(file, draft)
            client.log_artifact(run_id, str(sign(Path(draft) / path.name, self.key, expires=expires, now=now)))
        public = self.key.public
        until = FOR_EVER if expires is None else expires.isoformat()
        return {BY: public.name, FINGERPRINT: public.fingerprint, UNTIL: until}

    def _holds(self, known: Mapping[str, str]) -> bool:
        until = known.get(UNTIL, "")
        if known.get(FINGERPRINT) != self.key.public.fingerprint or (until == FOR_EVER) != (self.lasting is None):
            return False
        if self.lasting is None:
            return True
        try:
            return datetime.fromisoformat(until) - datetime.now(UTC) > self.lasting / 2
        except (ValueError, TypeError):
            return False


def present(tags: Mapping[str, str]) -> dict[str, str]:
    """Tags of a version that say who signed it; nothing where nobody did."""
    return {name: tags[name] for name in (BY, FINGERPRINT, UNTIL) if name in tags}


def words(tags: Mapping[str, str]) -> str:
    """Signer of a version by its tags; nothing where nobody signed it. Only a verification proves it."""
    if FINGERPRINT not in tags:
        return ""
    until = tags.get(UNTIL, FOR_EVER)
    return f"{tags.get(BY, '?')} (key {tags[FINGERPRINT][:16]}){'' if until == FOR_EVER else f', until {until[:10]}'}"


def trusted(given: Sequence[Path] | None, environment: Mapping[str, str] = os.environ) -> list[Path] | None:
    """The public keys that somebody gave, or that the environment names; None where there are none."""
    if given:
        return list(given)
    named = [Path(name) for name in environment.get(TRUSTED, "").split(os.pathsep) if name]
    return named or None
