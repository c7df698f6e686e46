"""Kinds of a table of fleet.toml, by name: our own, and those that installed packages add.

A package adds a kind by an entry point whose name is the kind and whose value is the table's class, in the group of the
table (`starling.laws`, `starling.triggers`). Installed packages are looked through only for a name that is none of
ours, so that nobody else pays for it, and none of ours can be replaced. All vehicles must have the same package: its
name, its version and the digest of its files are part of the fleet's shared hash.
"""

import json
from collections.abc import Iterable, Mapping
from hashlib import blake2s
from pathlib import Path
from typing import TYPE_CHECKING, Any, Generic, NamedTuple, TypeVar

from pydantic.fields import FieldInfo
from pydantic_core import PydanticCustomError

from companion.config.numbers import Table
from companion.errors import ConfigError

if TYPE_CHECKING:
    from importlib.metadata import EntryPoint


class KindTable(Table):
    """A table whose `kind` says which class of table it is."""

    kind: str


T = TypeVar("T", bound=KindTable)


class Origin(NamedTuple):
    """Where a kind that is not ours comes from."""

    group: str
    """of its entry point"""
    kind: str
    package: str
    """name of the distribution"""
    version: str
    source: str
    """digest of every file of the package"""


class Registry(Generic[T]):
    """The kinds of one table."""

    def __init__(self, group: str, base: type[T], *ours: type[T]) -> None:
        """`ours` are the kinds of this package; the first is that of a table which names none."""
        self.group = group
        self._base = base
        self._ours = {str(t.model_fields["kind"].default): t for t in ours}
        self._found: dict[str, tuple[type[T], Origin]] = {}

    def known(self) -> tuple[str, ...]:
        """Every kind: ours, then those of installed packages."""
        added = {p.name for p in _entry_points(self.group)} - self._ours.keys()
        return (*self._ours, *sorted(added))

    def table(self, kind: str) -> type[T] | None:
        """The class of the tables of a kind; None if there is none. ConfigError if the package that adds it is broken,
        or two do."""
        if kind in self._ours:
            return self._ours[kind]
        if kind not in self._found:
            points = [p for p in _entry_points(self.group) if p.name == kind]
            if not points:
                return None
            self._found[kind] = self._load(points)
        return self._found[kind][0]

    def _chosen(self, value: Mapping[str, Any]) -> type[T] | None:
        kind = value.get("kind", next(iter(self._ours)))
        return self.table(kind) if isinstance(kind, str) else None

    def fields(self, value: Any) -> Mapping[str, FieldInfo]:
        """What may stand in a table with these raw values: the keys of its kind, and those of ours."""
        tables = [*self._ours.values(), (self._chosen(value) if isinstance(value, Mapping) else None) or self._base]
        return {name: field for t in tables for name, field in t.model_fields.items()}

    def origin(self, kind: str) -> Origin | None:
        """Where a kind in use comes from; None for ours."""
        return self._found[kind][1] if kind in self._found else None

    def validate(self, value: Any) -> T:
        """A table from its raw values.

        Keys of our other kinds may stand beside those of the chosen one, so that one word changes the kind; they must
        be in range, and are of no meaning.
        """
        if isinstance(value, self._base):
            return value
        if not isinstance(value, Mapping):
            raise PydanticCustomError("model_type", "Input should be a table")
        table = self._chosen(value)
        if table is None:
            raise PydanticCustomError("kind", "unknown", {"known": ", ".join(self.known()), "came": value["kind"]})
        others = self.fields(value).keys() - table.model_fields.keys()
        beside = {k: v for k, v in value.items() if k in others}
        made = table.model_validate_json(json.dumps({k: v for k, v in value.items() if k not in beside}))
        for other in self._ours.values():
            other.model_validate_json(json.dumps({k: v for k, v in beside.items() if k in other.model_fields}))
        return made

    def _load(self, points: list["EntryPoint"]) -> tuple[type[T], Origin]:
        point = points[0]
        packages = sorted({p.dist.name for p in points if p.dist is not None})
        if len(packages) != 1 or point.dist is None:
            raise ConfigError(f"kind {point.name!r} of {self.group} is added by {' and '.join(packages)}: keep one")
        where = f"package {packages[0]}: {self.group}: {point.name} = {point.value}"
        try:
            table = point.load()
        except Exception as error:  # what a foreign package raises is anything
            raise ConfigError(f"{where}: cannot be loaded: {type(error).__name__}: {error}") from error
        if not (isinstance(table, type) and issubclass(table, self._base)):
            raise ConfigError(f"{where}: must be a subclass of {self._base.__module__}.{self._base.__name__}")
        if "kind" not in table.model_fields or table.model_fields["kind"].default != point.name:
            raise ConfigError(f'{where}: its table must say kind: Literal["{point.name}"] = "{point.name}"')
        return table, Origin(self.group, point.name, packages[0], point.dist.version, source_hash(point.module))


def _entry_points(group: str) -> "Iterable[EntryPoint]":
    """Those of the installed packages; what finds them costs a third of a companion's start, and is rarely wanted."""
    from importlib.metadata import entry_points

    return entry_points(group=group)


def source_hash(module: str) -> str:
    """A digest of every file of the package in which a module lies, of names and contents."""
    from importlib.util import find_spec

    spec = find_spec(module.partition(".")[0])
    digest = blake2s(digest_size=8)
    if spec is None:
        return digest.hexdigest()
    folders = [Path(p) for p in spec.submodule_search_locations or ()]
    files = [(f, p) for f in folders for p in f.rglob("*") if p.is_file() and "__pycache__" not in p.parts]
    if not folders and spec.origin is not None:
        files = [(Path(spec.origin).parent, Path(spec.origin))]
    for name, path in sorted((p.relative_to(f).as_posix(), p) for f, p in files):
        content = path.read_bytes()
        digest.update(f"{name}\0{len(content)}\0".encode() + content)
    return digest.hexdigest()
