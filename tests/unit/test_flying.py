"""Which fleet a verb without --fleet is for: what flies here, and never another than the folder's file names."""

import os
import tempfile
from contextlib import ExitStack
from pathlib import Path

import pytest

from companion.errors import ConfigError
from companion.operator.flying import flying_files, noted, operated_file

HERE = Path("fleet.toml")


@pytest.fixture(autouse=True)
def alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A folder for temporary files, and one to stand in, that no other test has."""
    (tmp_path / "here").mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    monkeypatch.chdir(tmp_path / "here")


def flight(folder: Path, name: str) -> Path:
    file = folder / name / "fleet.toml"
    file.parent.mkdir()
    file.write_text(f'[fleet]\nname = "{name}"\n')
    return file


def test_nothing_flies_and_the_folders_file_is_meant(tmp_path: Path) -> None:
    assert flying_files() == {}
    assert operated_file(None) == HERE
    assert operated_file(tmp_path / "mine.toml") == tmp_path / "mine.toml"


def test_the_only_flight_is_found_as_long_as_it_lasts(tmp_path: Path) -> None:
    file = flight(tmp_path, "one")
    with noted("one", file):
        assert flying_files() == {"one": file}
        assert operated_file(None) == file
        assert operated_file(tmp_path / "mine.toml") == tmp_path / "mine.toml"
    assert flying_files() == {}
    assert operated_file(None) == HERE


def test_a_file_here_is_flown_over_only_by_a_flight_of_its_name(tmp_path: Path) -> None:
    one, two = flight(tmp_path, "one"), flight(tmp_path, "two")
    HERE.write_text('[fleet]\nname = "two"\n')
    with noted("one", one):
        assert operated_file(None) == HERE
        with noted("two", two):
            assert operated_file(None) == two


@pytest.mark.parametrize("text", ["", "fleet = 3", "[fleet]\nname = 5"])
def test_a_file_here_without_a_name_is_read_and_refused_as_ever(tmp_path: Path, text: str) -> None:
    HERE.write_text(text)
    with noted("one", flight(tmp_path, "one")):
        assert operated_file(None) == HERE


def test_of_several_flights_the_operator_says_which(tmp_path: Path) -> None:
    with ExitStack() as stack:
        for name in ("one", "two"):
            stack.enter_context(noted(name, flight(tmp_path, name)))
        with pytest.raises(ConfigError, match=r"say which is meant: one: --fleet .*one/fleet.toml; two: --fleet"):
            operated_file(None)


def test_what_a_killed_launcher_left_names_nobody(tmp_path: Path) -> None:
    file = flight(tmp_path, "one")
    child = os.fork()
    if not child:
        with noted("one", file):
            os._exit(9)  # as by SIGKILL: nothing is cleaned up
    os.waitpid(child, 0)
    assert (tmp_path / f"starling-fleet-{os.getuid()}" / "one.flying").exists()
    assert flying_files() == {}
    with noted("one", file):
        assert flying_files() == {"one": file}


def test_a_flight_that_ended_leaves_no_note(tmp_path: Path) -> None:
    with noted("one", flight(tmp_path, "one")):
        pass
    assert list((tmp_path / f"starling-fleet-{os.getuid()}").iterdir()) == []


def test_a_note_without_a_file_yet_names_nobody(tmp_path: Path) -> None:
    (tmp_path / "one").mkdir()
    for file in (tmp_path / "one" / "fleet.toml", tmp_path / "one"):  # not written yet; a folder
        with noted("one", file):
            assert flying_files() == {}
            assert operated_file(None) == HERE


def test_nothing_is_written_where_others_may_write(tmp_path: Path) -> None:
    shared = tmp_path / f"starling-fleet-{os.getuid()}"
    shared.mkdir()
    shared.chmod(0o777)
    with noted("one", flight(tmp_path, "one")):
        assert flying_files() == {}
    assert list(shared.iterdir()) == []


def test_a_folder_of_somebody_elses_making_is_not_believed(tmp_path: Path) -> None:
    file = flight(tmp_path, "one")
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / f"starling-fleet-{os.getuid()}").symlink_to(tmp_path / "elsewhere")
    with noted("one", file):
        assert flying_files() == {}
    assert list((tmp_path / "elsewhere").iterdir()) == []


def test_without_a_place_to_note_it_a_flight_goes_on(tmp_path: Path) -> None:
    (tmp_path / f"starling-fleet-{os.getuid()}").write_text("a file")
    with noted("one", flight(tmp_path, "one")):
        assert flying_files() == {}
