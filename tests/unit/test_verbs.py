"""The operator's commands: the same from `fleet` and from `companion operator`, with little to load and plain words."""

import subprocess
import sys
from pathlib import Path

import pytest
from typer.testing import CliRunner

import companion.__main__
import companion.io.network
import sim.__main__
from companion.errors import CompanionError, RefusedError
from companion.io.transport import TransportError

VERBS = {
    "init",
    "status", "preflight", "takeoff", "land", "rtl", "hold", "form", "move", "scare", "release", "resume", "kill",
}  # fmt: skip
HEAVY = ("zenoh", "pymavlink", "scipy", "shapely", "mcap", "companion.config", "companion.io", "sim.launch")
FLEET_TOML = str(Path(__file__).resolve().parents[2] / "fleet.toml")


def python(code: str, *arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-c", code, *arguments], capture_output=True, text=True, timeout=60, check=False,
        stdin=subprocess.DEVNULL,
    )  # fmt: skip


def names(app: object) -> set[str]:
    return {c.callback.__name__ for c in app.registered_commands}  # type: ignore[attr-defined]


def test_both_commands_have_every_verb() -> None:
    assert names(companion.__main__.operator_app) == VERBS
    assert names(sim.__main__.app) > VERBS


@pytest.mark.parametrize("module", ["companion", "sim"])
def test_help_loads_none_of_the_flight(module: str) -> None:
    done = python(
        f"import sys, {module}.__main__ as m\n"
        "try: m.main()\n"
        f"finally: print([n for n in {HEAVY} if n in sys.modules], file=sys.stderr)",
        "--help",
    )
    assert done.returncode == 0, done.stderr
    assert done.stderr.strip() == "[]"


@pytest.mark.parametrize("verb", sorted(VERBS - {"init"}))
def test_each_verb_has_a_help_of_its_own(verb: str) -> None:
    done = CliRunner().invoke(companion.__main__.app, ["operator", verb, "--help"])
    assert done.exit_code == 0
    assert "--fleet" in done.output
    assert len(" ".join(done.output.split())) > 300


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["move"], "move needs exactly one of --velocity, --turn, --goto, --free, got none"),
        (["move", "--turn", "6", "90", "--goto", "1", "2"], "got --turn and --goto"),
        (["move", "--turn", "0", "90"], "the rate must not be 0 deg/s, got 0; to stop the formation, use hold"),
        (["move", "--turn", "6", "90", "--altitude", "12"], "--altitude belongs to --goto, got it with --turn"),
        (["move", "--vehicle", "3", "--goto", "1", "2"], "move --goto is for all"),
        (["scare", "--at", "1e5", "0"], "scare --at: each number must be within 10000 m, got 100000 0"),
        (["scare", "--at", "0", "nan"], "scare --at: each number must be within 10000 m, got 0 nan"),
        (
            ["scare", "--at", "0", "0", "--velocity", "0", "31"],
            "scare --velocity: each number must be within 30 m/s, got 0 31",
        ),
        (["land", "--fleet", "nowhere.toml"], "nowhere.toml: cannot be read"),
    ],
)
@pytest.mark.parametrize("command", ["companion", "fleet"])
def test_wrong_usage_is_one_sentence_and_a_status_of_its_own(
    command: str, arguments: list[str], said: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    main = companion.__main__.main if command == "companion" else sim.__main__.main
    monkeypatch.setattr(sys, "argv", [command, *(["operator"] if command == "companion" else []), *arguments])
    with pytest.raises(SystemExit) as ended:
        main()
    assert ended.value.code == 2
    err = capsys.readouterr().err
    assert err.startswith(f"{command}: ")
    assert said in err
    assert err.count("\n") == 1


@pytest.mark.parametrize("error", [TransportError("no network"), RefusedError("not yet"), CompanionError("no line")])
@pytest.mark.parametrize("command", ["companion", "fleet"])
def test_both_commands_end_alike_where_nobody_could_be_commanded(
    command: str, error: CompanionError, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def fails(config: object) -> None:
        raise error

    monkeypatch.setattr(companion.io.network, "operator_link", fails)
    main = companion.__main__.main if command == "companion" else sim.__main__.main
    verb = [*(["operator"] if command == "companion" else []), "land", "--fleet", FLEET_TOML]
    monkeypatch.setattr(sys, "argv", [command, *verb])
    with pytest.raises(SystemExit) as ended:
        main()
    assert ended.value.code == 1
    assert capsys.readouterr().err == f"{command}: {error}\n"


def test_a_kill_that_nobody_confirms_commands_nobody() -> None:
    done = python("import companion.__main__ as m; m.main()", "operator", "kill", "--fleet", FLEET_TOML)
    assert done.returncode == 1
    assert "kill was not confirmed: type kill when it asks, or give --yes" in done.stderr
    assert "Traceback" not in done.stderr


def test_a_replay_without_its_library_says_which_extra_to_install() -> None:
    done = python(
        "import sys; sys.modules['mcap'] = None; import companion.__main__ as m; m.main()", "replay", "x.mcap"
    )
    assert done.returncode == 2
    assert done.stderr == (
        "companion: this command needs mcap, which is not installed: pip install 'starling-fleet[replay]'\n"
    )


def test_a_command_whose_libraries_are_missing_says_what_to_install_and_that_verbs_need_none_of_it() -> None:
    done = python("import sys; sys.modules['tomli_w'] = None; import sim.__main__ as m; m.main()", "up")
    assert done.returncode == 2, done.stderr
    assert "this command needs tomli_w, which is not installed: pip install 'starling-fleet[sim]'" in done.stderr
    assert "Traceback" not in done.stderr
