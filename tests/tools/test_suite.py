"""kpbench suite: which steps there are, which are done, and what happens when one fails."""

import json
import re
import shlex
import subprocess
from pathlib import Path
from typing import Any

import pytest

from kpc.tools.bench import kpbench, suite, suite_steps
from kpc.tools.bench.report.trades import COMMANDS
from kpc.tools.bench.suite_steps import HOUR, QUICK, Step
from kpc.tools.dev import scenegen

COMMIT = "0123456789abcdef" * 2
# Three steps: a scene, an encoding that others read, and what plays it.
STEPS = [
    Step("scene", ("kpc.tools.dev.scenegen", "room"), 1, (), ("room/done",), False),
    Step("encode", ("encode", "room"), 10, ("scene",), ("kept/room.kpc",)),
    Step("player", ("player", "kept/room.kpc"), 2, ("encode",)),
    Step("other", ("decode", "room"), 3, ("scene",)),
]


class Machine:
    """Stands in for the processes of steps: writes what a step makes, and keeps count."""

    def __init__(self) -> None:
        self.ran: list[str] = []
        self.failing: set[str] = set()
        self.commit = COMMIT
        self.commit_after = COMMIT

    def run(self, command: list[str], cwd: Path, stdout: Any, **_: Any) -> "subprocess.CompletedProcess[bytes]":
        (step,) = [step for step in STEPS if command[2:] == list(step.module)]
        self.ran.append(step.name)
        self.commit = self.commit_after
        if step.name in self.failing:
            stdout.write("first line\nkpbench: no room\n")
            (cwd / step.file).write_text("[")
            return subprocess.CompletedProcess(command, 1)
        for made in step.makes:
            (cwd / made).parent.mkdir(exist_ok=True)
            (cwd / made).touch()
        if step.has_records:
            (cwd / step.file).write_text(json.dumps([{"commit": self.commit, "command": shlex.join(step.command)}]))
        return subprocess.CompletedProcess(command, 0)


@pytest.fixture
def machine(monkeypatch: pytest.MonkeyPatch) -> Machine:
    made = Machine()
    monkeypatch.setattr(suite, "generated", lambda _: STEPS)
    monkeypatch.setattr(suite.subprocess, "run", made.run)
    monkeypatch.setattr(suite.provenance, "commit", lambda: made.commit)
    return made


def ran(machine: Machine, *arguments: str) -> list[str]:
    """Run the suite, which must succeed, and return the steps that ran."""
    machine.ran = []
    assert kpbench.main(["suite", *arguments]) == 0
    return machine.ran


ALL = suite_steps.generated(HOUR), suite_steps.generated(QUICK), suite_steps.of_scene("x")


@pytest.mark.parametrize("steps", ALL)
def test_steps_are_commands_whose_needs_come_first(steps: list[Step], capsys: pytest.CaptureFixture[str]) -> None:
    names = [step.name for step in steps]
    assert len({*names}) == len(names)
    made: set[str] = set()
    for number, step in enumerate(steps):
        assert {*step.needs} <= {*names[:number]}
        files = {word for word in step.words if re.search(r"\.kpck?$", word)}
        assert files <= made, f"{step.name} reads what no step before it makes"
        made |= {*step.makes}
        main, words = (kpbench.main, step.words) if step.has_records else (scenegen.main, step.words[1:])
        with pytest.raises(SystemExit):
            main([words[0], "--help"] if step.has_records else ["--help"])
        known = {*re.findall(r"--[a-z][a-z-]*", capsys.readouterr().out)}
        assert {word.split("=")[0] for word in words if word.startswith("--")} <= known, step.name


def test_generated_scenes_take_less_than_an_hour_and_make_every_kind() -> None:
    steps = suite_steps.generated(HOUR)
    assert sum(step.minutes for step in steps) <= 60
    made = {step.words[0] for step in steps}
    assert {command.split()[1] for command in COMMANDS.values()} - made == {"ceiling"}  # it takes an hour by itself
    timed = {"player", "stream", "window", "step", "scaling", "decode"}
    assert all("--repeats" in step.words for step in steps if step.words[0] in timed)


def test_what_is_done_is_not_done_again(machine: Machine, tmp_path: Path) -> None:
    out = tmp_path / "out"
    assert ran(machine, "-o", str(out)) == ["scene", "encode", "player", "other"]
    assert sorted(path.name for path in out.iterdir()) == [
        "encode.json",
        "other.json",
        "player.json",
        "report.html",
        "work",
    ]
    assert ran(machine, "-o", str(out)) == []
    (out / "player.json").unlink()
    assert ran(machine, "-o", str(out)) == ["player"]
    (out / "work" / COMMIT[:9] / "kept" / "room.kpc").unlink()
    assert ran(machine, "-o", str(out)) == ["encode"]
    text = (out / "other.json").read_text()
    (out / "other.json").write_text(text.replace("kpbench", "kpbench --seed 1"))
    assert ran(machine, "-o", str(out)) == ["other"]
    machine.commit = machine.commit_after = COMMIT[::-1]
    assert ran(machine, "-o", str(out)) == ["scene", "encode", "player", "other"]
    assert {record["commit"] for path in out.glob("*.json") for record in json.loads(path.read_text())} == {
        COMMIT[::-1]
    }


def test_only_some_steps_and_what_they_need(
    machine: Machine, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert ran(machine, "-o", str(tmp_path), "--only", "play") == ["scene", "encode", "player"]
    assert "other.json" not in {path.name for path in tmp_path.iterdir()}
    assert kpbench.main(["suite", "-o", str(tmp_path), "--only", "room"]) == 2
    assert "--only room: the steps are scene, encode, player, other" in capsys.readouterr().err


def test_the_plan_runs_nothing(machine: Machine, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    machine.commit = f"{COMMIT}+dirty"
    assert ran(machine, "-o", str(tmp_path / "out"), "--plan") == [] and not (tmp_path / "out").exists()
    *lines, total = capsys.readouterr().out.splitlines()
    assert "kpbench player kept/room.kpc --out player.json" in lines[2] and total.split()[0] == "16.0"


@pytest.mark.parametrize(
    ("commit", "said"),
    [(f"{COMMIT}+dirty", "commit your changes"), ("unknown", "run it from a checkout of KPC in git")],
)
def test_code_that_no_commit_holds_is_refused_or_marked(
    machine: Machine, tmp_path: Path, commit: str, said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    machine.commit = machine.commit_after = commit
    assert kpbench.main(["suite", "-o", str(tmp_path)]) == 2 and not machine.ran
    err = capsys.readouterr().err
    assert said in err and "--allow-dirty" in err
    for _ in range(2):  # nothing is kept, since nobody knows what changed in between
        assert len(ran(machine, "-o", str(tmp_path), "--allow-dirty")) == 4
    assert json.loads((tmp_path / "player.json").read_text())[0]["commit"] == commit


def test_a_failed_step_stops_only_what_needs_it(
    machine: Machine, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    machine.failing = {"encode"}
    assert kpbench.main(["suite", "-o", str(tmp_path)]) == 1
    said = capsys.readouterr().err
    assert machine.ran == ["scene", "encode", "other"] and "kpbench: no room" in said
    assert "player: left out, encode failed" in said and "2 of 4 steps failed: encode, player; run again" in said
    assert not (tmp_path / "encode.json").exists()
    machine.failing = set()
    assert ran(machine, "-o", str(tmp_path)) == ["encode", "player"]


def test_the_code_must_not_change_meanwhile(
    machine: Machine, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    machine.commit_after = f"{COMMIT}+dirty"
    assert kpbench.main(["suite", "-o", str(tmp_path)]) == 1 and machine.ran == ["scene"]
    assert "changed from" in capsys.readouterr().err


def test_what_a_machine_lacks_is_no_failure(
    machine: Machine, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    windowed = [*STEPS[:2], Step("player", STEPS[2].words, 2, ("encode",), missing=lambda: "needs a display")]
    monkeypatch.setattr(suite, "generated", lambda _: windowed)
    assert ran(machine, "-o", str(tmp_path)) == ["scene", "encode"]
    assert "player: left out, needs a display" in capsys.readouterr().err


def test_scenes_that_are_given_have_steps_of_their_own(
    machine: Machine, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for folder in ("one/room", "two/room", "hall"):
        (tmp_path / folder).mkdir(parents=True)
    scenes = ["--scene", str(tmp_path / "one/room"), "--scene", str(tmp_path / "hall")]
    assert ran(machine, "-o", str(tmp_path / "out"), "--plan", *scenes) == []
    plan = capsys.readouterr().out
    assert "kpbench encode room --preset best" in plan and " quality-hall " in plan and str(tmp_path) not in plan
    both = ["--scene", str(tmp_path / "one/room"), "--scene", str(tmp_path / "two/room")]
    assert kpbench.main(["suite", "-o", str(tmp_path / "out"), *both]) == 2
    assert "two scenes have one name" in capsys.readouterr().err
