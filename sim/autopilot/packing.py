"""Frames of pymavlink's message classes at a fifth of its own cost, for a machine's worth of stubs. Same bytes."""

import os
from collections.abc import Callable
from functools import cache
from operator import attrgetter
from typing import Any, NamedTuple

os.environ.setdefault("MAVLINK20", "1")
# CURRENT_MODE (436) is not in the `common` dialect of pymavlink 2.4; `development` includes all of `common`.
from pymavlink.dialects.v20 import development as mavlink

from companion.wire.mavlink_frames import HEAD_2, Layout, checksum_fits

__all__ = ["Fields", "frame", "mavlink", "packed", "unpacked"]


class Fields(NamedTuple):
    """A message that a companion has sent many times a second, without pymavlink's object around its values."""

    kind: Any
    """its class in pymavlink"""
    values: tuple[Any, ...]
    """of its fields in the wire's order"""


@cache
def _layout(kind: Any) -> Layout:
    return Layout(kind.id, bytes((kind.crc_extra,)), kind.unpacker)


@cache
def _fields(kind: Any) -> Callable[[Any], tuple[Any, ...]] | None:
    """A message's fields in the wire's order; None for a class with arrays, which pymavlink packs by itself."""
    names = kind.ordered_fieldnames
    return attrgetter(*names) if len(names) > 1 and not any(kind.array_lengths) else None


def frame(kind: Any, values: tuple[Any, ...], link: Any) -> bytes:
    """One MAVLink 2 frame of a message class from its fields' values in the wire's order.

    Like pymavlink's `message.pack(link)` it leaves the link's sequence number as it is.
    """
    return _layout(kind).pack(values, link.seq, link.srcSystem, link.srcComponent)


def packed(message: Any, link: Any) -> bytes:
    """The same of one of pymavlink's messages."""
    kind: Any = type(message)
    fields = _fields(kind)
    return bytes(message.pack(link)) if fields is None else frame(kind, fields(message), link)


def unpacked(kind: Any, datagram: bytes) -> tuple[Any, ...] | None:
    """The values of a frame's fields in the wire's order; None where the checksum is wrong.

    That the datagram is one whole, unsigned MAVLink 2 frame of this message class is the caller's to have seen.
    """
    layout = _layout(kind)
    return layout.unpack(datagram[HEAD_2:-2]) if checksum_fits(datagram, len(datagram) - 2, layout.extra) else None
