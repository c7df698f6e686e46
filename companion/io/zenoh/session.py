"""Opens and closes Zenoh sessions."""

from contextlib import suppress

import zenoh

from companion.io.transport import TransportError
from companion.io.zenoh.configuration import SessionSettings, zenoh_configuration


def open_session(settings: SessionSettings) -> zenoh.Session:
    """A session of these settings; TransportError when its endpoints cannot be used."""
    # Zenoh logs to standard output, which belongs to `--json`: only when RUST_LOG asks for it.
    zenoh.try_init_log_from_env()  # type: ignore[no-untyped-call]
    try:
        return zenoh.open(zenoh_configuration(settings))
    except zenoh.ZError as error:
        raise TransportError(f"fleet {settings.fleet_name!r}: {error}") from error


def close_session(session: zenoh.Session | None) -> None:
    """End it, or its threads would keep the interpreter from ending; may be called again.

    One whose radio is gone cannot tell its peers in time, and has ended all the same.
    """
    if session is not None and not session.is_closed():
        with suppress(zenoh.ZError):
            session.close()  # type: ignore[no-untyped-call]
