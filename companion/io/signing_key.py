"""A vehicle's signing key in a file of its own, and the time that was signed by last beside it."""

import os
import secrets
import stat
from contextlib import suppress
from pathlib import Path

from companion.errors import CompanionError, ConfigError
from companion.wire.signing import KEY_BYTES, TICKS_PER_S

MODE = 0o600
RESERVE_S = 120
"""the file is so much ahead of what has been signed: whatever ends the process, a number is not used twice"""


def read_key(path: Path) -> bytes:
    """The 32 bytes; ConfigError says what is wrong with the file, what is allowed and how to mend it."""
    try:
        mode = stat.S_IMODE(path.stat().st_mode)
        text = path.read_text(encoding="ascii").strip()
    except (OSError, UnicodeDecodeError) as error:
        why = error.strerror if isinstance(error, OSError) else "is no text"
        raise ConfigError(
            f"signing key {path}: cannot be read ({why}); `companion signing make {path}` makes one"
        ) from None
    if mode & 0o077:
        raise ConfigError(
            f"signing key {path}: may be read or written by others (mode {mode:o}), must be {MODE:o}: "
            f"`chmod {MODE:o} {path}`, and another key if a stranger may have read it"
        )
    try:
        key = bytes.fromhex(text)
    except ValueError:
        key = b""
    if len(key) != KEY_BYTES:
        raise ConfigError(
            f"signing key {path}: must be {2 * KEY_BYTES} hexadecimal digits, got {len(text)} characters; "
            "`companion signing make FILE` makes one"
        )
    if not any(key):
        raise ConfigError(f"signing key {path}: is all zeros, which means no key; `companion signing make FILE`")
    return key


def make_key(path: Path) -> None:
    """Write a new random key; CompanionError where there is a file already."""
    try:
        fd = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, MODE)
    except FileExistsError:
        raise CompanionError(f"{path} is there already: a key that an autopilot knows is not overwritten") from None
    except OSError as error:
        raise CompanionError(f"cannot write {path}: {error.strerror}") from error
    with os.fdopen(fd, "w", encoding="ascii") as file:
        file.write(f"{secrets.token_hex(KEY_BYTES)}\n")


class SignedTime:
    """The time stamp that was used last, in KEY.time: a computer without a battery-backed clock starts in the past."""

    def __init__(self, key_file: Path) -> None:
        self.path = key_file.with_name(f"{key_file.name}.time")
        self.failed = ""
        """why it could not be written, the first time"""
        self._reserved = self._stored()

    def _stored(self) -> int:
        try:
            return max(int(self.path.read_text(encoding="ascii")), 0)
        except (OSError, ValueError):
            return 0

    @property
    def not_before(self) -> int:
        """No frame is to be signed with an earlier number."""
        return self._reserved

    def keep(self, ticks: int) -> None:
        """Have the file ahead of this number; a disk that is full ends no flight."""
        if ticks + RESERVE_S * TICKS_PER_S // 2 >= self._reserved:
            self._write(ticks + RESERVE_S * TICKS_PER_S)

    def end(self, ticks: int) -> None:
        """No more is signed: this was the last number."""
        self._write(ticks + 1)

    def _write(self, reserved: int) -> None:
        half = self.path.with_name(f"{self.path.name}.{os.getpid()}.part")
        try:
            half.write_text(f"{reserved}\n", encoding="ascii")
            half.replace(self.path)
        except OSError as error:
            self.failed = self.failed or f"{self.path}: {error.strerror}"
            with suppress(OSError):
                half.unlink()
        # Tried again when half of it has been used, whether it was written or not.
        self._reserved = reserved
