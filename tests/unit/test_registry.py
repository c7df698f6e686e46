"""Kinds of law and trigger that other packages add: found by name, told apart by their source, refused by name."""

import itertools
import json
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from companion.config import FleetConfig
from companion.config import registry as registry_module
from companion.config.file import parse
from companion.config.registry import source_hash
from companion.core.law.starling import StarlingLaw
from companion.core.values import Instant
from companion.errors import ConfigError
from companion.io.recorder import Recorder
from companion.io.replay import replay_file
from companion.vehicle.agent import Agent
from companion.vehicle.guest import GuestLaw, GuestTrigger

LAW = """
from typing import Annotated, Literal
from pydantic import Field
from companion.config.law_tables import LawTable
from companion.core.law.paper import paper_gains
from companion.core.law.starling import StarlingLaw

class Mine(LawTable):
    kind: Literal["KIND"] = "KIND"
    stiffness_per_s2: Annotated[float, Field(gt=0, le=9)] = 1.0

    def law(self, r0_m):
        return StarlingLaw(paper_gains(1.0, 1.0, self.stiffness_per_s2, r0_m))
"""
TRIGGER = """
from typing import Literal
from companion.config.trigger_tables import TriggerTable

class Rule:
    waits = True
    cause = "its mood"
    def fires(self, now):
        return False
    def error_bound_m(self, motion):
        return BOUND

class Mine(TriggerTable):
    kind: Literal["KIND"] = "KIND"

    def trigger(self):
        return Rule()
"""
_numbers = itertools.count()


class Packages:
    """Packages made up for a test, each in a folder of its own on the path."""

    def __init__(self, folder: Path, patch: pytest.MonkeyPatch) -> None:
        self.folder, self.patch = folder, patch

    def add(self, group: str, kind: str, source: str, *, name: str | None = None, version: str = "1.0") -> Path:
        """Install a package with one module that adds a kind; returns its folder."""
        module = f"made_up_{next(_numbers)}"
        name = name or module.replace("_", "-")
        site = self.folder / module
        information = site / f"{module}-{version}.dist-info"
        information.mkdir(parents=True)
        (information / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: {version}\n")
        (information / "entry_points.txt").write_text(f"[{group}]\n{kind} = {module}:Mine\n")
        package = site / module
        package.mkdir()
        (package / "__init__.py").write_text(source.replace("KIND", kind))
        self.patch.syspath_prepend(str(site))
        return package

    def law(self, source: str = LAW, **more: Any) -> str:
        """A law under a kind that no other test has."""
        kind = f"kind-{next(_numbers)}"
        self.add("starling.laws", kind, source, **more)
        return kind

    def trigger(self, bound: str) -> str:
        kind = f"kind-{next(_numbers)}"
        self.add("starling.triggers", kind, TRIGGER.replace("BOUND", bound))
        return kind


@pytest.fixture
def packages(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Packages]:
    before = set(sys.modules)
    yield Packages(tmp_path, monkeypatch)
    for name in set(sys.modules) - before:
        if name.startswith("made_up_"):
            del sys.modules[name]


def fleet(**tables: Any) -> FleetConfig:
    return parse(
        {"fleet": {"name": "two", "frame": "local"}, "vehicle": [{"id": 1}, {"id": 2}], **tables}, "fleet.toml"
    )


def test_a_kind_of_a_package_is_a_table_like_ours(packages: Packages) -> None:
    kind = packages.law()
    config = fleet(law={"kind": kind, "stiffness_per_s2": 2.0, "a_max_m_s2": 4.0, "k_v": 1.0})
    law = config.law.law(config.r0_m)
    assert isinstance(law, StarlingLaw)
    assert law.gains.k_c == 2.0
    assert config.peer_motion.a_max_m_s2 == 4.0
    assert [(o.group, o.kind, o.version) for o in config.foreign] == [("starling.laws", kind, "1.0")]
    assert isinstance(Agent(config, 1, 7).law, GuestLaw)
    assert not isinstance(Agent(config, 1, 7).publisher.trigger, GuestTrigger)
    assert fleet().foreign == ()


@pytest.mark.parametrize(
    ("value", "says"),
    [
        ({"stiffness_per_s2": -1.0}, r"\$\.law\.stiffness_per_s2 must be a finite number > 0 and <= 9.*got -1"),
        ({"stiffnes": 1.0}, r"\$\.law\.stiffnes is not a known key; known here: .*stiffness_per_s2"),
        ({"k_s": -1.0}, r"\$\.law\.k_s must be a finite number >= 0"),
    ],
)
def test_its_parameters_are_refused_as_ours_are(packages: Packages, value: dict[str, Any], says: str) -> None:
    kind = packages.law()
    with pytest.raises(ConfigError, match=says):
        fleet(law={"kind": kind, **value})


def test_a_kind_that_nobody_adds_is_refused_and_those_that_are_there_are_named(packages: Packages) -> None:
    kind = packages.law()
    with pytest.raises(ConfigError, match=rf"\$\.law\.kind must be one of .*, intent, .*{kind}.*got 'boids'"):
        fleet(law={"kind": "boids"})


@pytest.mark.parametrize(
    ("source", "says"),
    [
        ("raise RuntimeError('no luck')", "cannot be loaded: RuntimeError: no luck"),
        ("Mine = 3", "must be a subclass of companion.config.law_tables.LawTable"),
        (LAW.replace("KIND", "other"), 'its table must say kind: Literal'),
        (LAW.replace("return StarlingLaw", "raise ValueError('not today') or StarlingLaw"), "be made: ValueError: not"),
        (LAW.replace("return StarlingLaw", "return 3 or StarlingLaw"), "cannot be made: AttributeError"),
    ],
)  # fmt: skip
def test_a_package_that_is_broken_is_refused_by_name(packages: Packages, source: str, says: str) -> None:
    kind = packages.law(source)
    with pytest.raises(ConfigError, match=says):
        fleet(law={"kind": kind})


def test_a_kind_that_two_packages_add_is_refused(packages: Packages) -> None:
    kind = packages.law(name="first")
    packages.add("starling.laws", kind, LAW, name="second")
    with pytest.raises(ConfigError, match="is added by first and second: keep one"):
        fleet(law={"kind": kind})


@pytest.mark.parametrize("bound", ["float('nan')", "float('inf')", "0.0", "-1.0", "'far'", "1/0"])
def test_a_trigger_without_a_sound_error_bound_is_refused(packages: Packages, bound: str) -> None:
    kind = packages.trigger(bound)
    with pytest.raises(ConfigError, match=rf"\$\.trigger\.kind = '{kind}'"):
        fleet(trigger={"kind": kind})


def test_the_safety_radius_is_made_from_a_foreign_triggers_bound(packages: Packages) -> None:
    config = fleet(trigger={"kind": packages.trigger("0.75")})
    assert config.safety_radius_m == pytest.approx(0.65 + 0.75)
    assert isinstance(Agent(config, 1, 7).publisher.trigger, GuestTrigger)


def test_nobody_looks_through_packages_for_a_kind_of_ours_and_none_can_replace_it(
    packages: Packages, monkeypatch: pytest.MonkeyPatch
) -> None:
    packages.add("starling.laws", "paper", LAW)
    looked: list[str] = []
    monkeypatch.setattr(registry_module, "_entry_points", lambda group: looked.append(group) or [])
    config = fleet(law={"kind": "paper", "hold": "zero"}, trigger={"kind": "switching"})
    assert type(config.law).__module__ == "companion.config.law_tables"
    assert looked == []


def test_vehicles_whose_packages_differ_have_different_hashes(packages: Packages) -> None:
    """By version, by a byte of any file, and for the same parameters."""
    one, other = packages.law(LAW, name="same"), packages.law(LAW, name="same", version="1.1")
    base = json.dumps(fleet(law={"kind": one}).model_dump()).replace(one, "kind")
    assert base == json.dumps(fleet(law={"kind": other}).model_dump()).replace(other, "kind")
    hashes = {fleet(law={"kind": k}).shared_hash for k in (one, other)} | {fleet().shared_hash}
    assert len(hashes) == 3


@pytest.mark.parametrize(
    "change",
    [
        lambda p: (p / "__init__.py").write_text((p / "__init__.py").read_text() + "\n"),
        lambda p: (p / "data.bin").write_bytes(b"\0"),
        lambda p: (p / "__init__.py").rename(p / "init.py"),
    ],
    ids=["a byte", "a file", "a name"],
)
def test_the_digest_of_a_package_sees_every_change(packages: Packages, change: Callable[[Path], Any]) -> None:
    package = packages.add("starling.laws", "any", LAW)
    before = source_hash(package.name)
    (package / "__pycache__").mkdir(exist_ok=True)
    (package / "__pycache__" / "x.pyc").write_bytes(b"1")
    assert source_hash(package.name) == before
    change(package)
    assert source_hash(package.name) != before


def test_a_recording_names_the_package_and_is_replayed_with_the_same_alone(packages: Packages, tmp_path: Path) -> None:
    kind = packages.law()
    toml = f'[fleet]\nname = "two"\nframe = "local"\n[law]\nkind = "{kind}"\n[[vehicle]]\nid = 1\n'
    flown = fleet(law={"kind": kind}).foreign
    for name, origins in (("same", flown), ("other", tuple(o._replace(source="0123") for o in flown))):
        facts = {
            "config": toml, "vehicle_id": "1", "boot_id": "7",
            "foreign": json.dumps([o._asdict() for o in origins]),
        }  # fmt: skip
        recorder = Recorder(tmp_path / name, facts)
        recorder.record("tick", Instant(0, 0), b"")
        recorder.close()
    assert replay_file(tmp_path / "same").same
    with pytest.raises(Exception, match=r"it was flown with .*0123"):
        replay_file(tmp_path / "other")
