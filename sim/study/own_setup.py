"""A user's own copy of a study's set-up: what is missing or unknown is told before anything is flown."""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from companion.errors import CompanionError, ConfigError


def same_tables(values: Mapping[str, Any], shipped: Mapping[str, Any], path: Path, original: Path) -> None:
    """Raise ConfigError unless a set-up has the tables of the study's own; what is in them is the study's to read."""
    faults = [f"$.{t} is missing" for t in shipped if t not in values]
    faults += [f"$.{t} is not known" for t in values if t not in shipped]
    faults += [
        f"$.{t} must be a {'table' if isinstance(wanted, Mapping) else 'list'}, got {values[t]!r:.60}"
        for t, wanted in shipped.items()
        if t in values and isinstance(wanted, Mapping) is not isinstance(values[t], Mapping)
    ]
    if faults:
        raise ConfigError(
            f"{path}: is no set-up of the study {original.stem}: {', '.join(faults)}; its tables are "
            f"{', '.join(shipped)}. Begin with a copy of {original}"
        )


@contextmanager
def flown_as(setup: Path | None, name: str) -> Iterator[None]:
    """What a study cannot make of a user's own set-up is the file's fault, and is said so; of the shipped one, ours."""
    try:
        yield
    except (CompanionError, OSError):
        raise
    except (KeyError, TypeError, ValueError, IndexError, AttributeError, ZeroDivisionError) as error:
        if setup is None:
            raise
        said = f"{error} is missing" if isinstance(error, KeyError) else f"{type(error).__name__}: {error}"
        original = Path(__file__).with_name(f"{name}.toml")
        what = f"{setup}: cannot be flown as a set-up of {name}"
        raise ConfigError(f"{what}: {said}. Compare it with {original}") from error
