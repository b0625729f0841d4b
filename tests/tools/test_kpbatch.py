"""kpbatch: jobs that are checked as a whole, results that are made once, and workers that are killed."""

import contextlib
import errno
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import threading
import time
import uuid
from collections.abc import Callable, Iterator
from concurrent.futures import CancelledError
from dataclasses import replace
from pathlib import Path
from typing import Any

import fsspec
import pytest
from distributed import Client, Future, LocalCluster

from kpc.format.common.errors import UsageError
from kpc.format.container.container import Reader
from kpc.tools.batch import engine, jobs, simulation, summary, working
from kpc.tools.batch.addresses import source_address
from kpc.tools.batch.engine import Engine, Event
from kpc.tools.batch.jobs import FaultyBatch, Job, Resources
from kpc.tools.batch.store import RESULT, SCENE, WORK, Store, StoreError
from kpc.tools.batch.tasks import ENCODE, Outcome, Task, done_before, first_tasks, tasks_of_groups
from kpc.tools.batch.working import Place
from kpc.tools.cli import kpbatch
from kpc.tools.cli.kpbatch import main

SAMPLE = Path(__file__).parent.parent.parent / "samples" / "default.kpc"
Report = Callable[[dict[str, float]], None]


@pytest.fixture
def take(tmp_path: Path) -> Path:
    """Return a folder that stands for one with videos."""
    folder = tmp_path / "take"
    folder.mkdir()
    (folder / "cam00.mp4").write_bytes(b"one")
    return folder


@pytest.fixture(scope="module")
def threads() -> Iterator[Client]:
    """A cluster within this process."""
    with (
        LocalCluster(
            n_workers=2, threads_per_worker=1, processes=False, dashboard_address=":0", resources={"cores": 2}
        ) as cluster,
        Client(cluster) as client,
    ):
        yield client


@pytest.fixture
def bucket(monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    """The address of an empty place on a server such as S3, on this machine."""
    needed = "s3fs, moto, flask and flask-cors"
    for package in ("s3fs", "flask_cors", "moto.server"):
        pytest.importorskip(package, reason=f"needs {needed}, which the extra test installs")
    from moto.server import ThreadedMotoServer

    server = ThreadedMotoServer(ip_address="127.0.0.1", port=0, verbose=False)
    server.start()
    host, port = server.get_host_and_port()
    for name, value in {
        "AWS_ENDPOINT_URL": f"http://{host}:{port}",
        "AWS_ACCESS_KEY_ID": "some",
        "AWS_SECRET_ACCESS_KEY": "thing",
        "AWS_DEFAULT_REGION": "us-east-1",
        "AWS_EC2_METADATA_DISABLED": "true",
    }.items():
        monkeypatch.setenv(name, value)
    fsspec.get_filesystem_class("s3").clear_instance_cache()
    name = f"bucket-{uuid.uuid4().hex}"  # the server's memory outlives it
    fsspec.filesystem("s3").mkdir(name)
    yield f"s3://{name}/place"
    server.stop()


def write(tmp_path: Path, text: str) -> Path:
    file = tmp_path / "jobs.toml"
    file.write_text(text)
    return file


def test_a_grid_makes_a_job_of_each_combination(tmp_path: Path, take: Path) -> None:
    text = (
        'output = "out"\n[options]\npreset = "fast"\nseed = 3\n[grid]\nquality = [40, 70]\nseed = [0, 1]\n'
        '[resources]\ncores = 2\nmemory = "3GB"\n'
        '[[scene]]\nsource = "take"\n[[scene]]\nsource = "take"\nname = "long"\noptions = { group = "10s", seed = 7 }\n'
    )
    batch = jobs.read_jobs(write(tmp_path, text))
    assert batch.output == str(tmp_path / "out")
    assert [job.name for job in batch.jobs] == [
        *("take.quality-40.seed-0", "take.quality-40.seed-1", "take.quality-70.seed-0", "take.quality-70.seed-1"),
        *("long.quality-40", "long.quality-70"),
    ]
    first, last = batch.jobs[0], batch.jobs[-1]
    assert first.options == ("--preset=fast", "--seed=0", "--quality=40") and not first.group
    assert last.options == ("--preset=fast", "--seed=7", "--quality=70", "--group=10s") and last.group
    assert first.source == str(take) and first.resources == Resources(2, 3_000_000_000)


@pytest.mark.parametrize(
    "text, fault",
    [
        ('colour = 1\noutput = "out"\n[[scene]]\nsource = "take"\n', "jobs.toml:1: 'colour' is not known"),
        ('[[scene]]\nsource = "take"\n', "output names the folder"),
        ('output = "out"\n', "there is no scene"),
        ('output = "out"\n[[scene]]\nsource = "none"\n', "jobs.toml:3: {0}/none: no such file or folder"),
        ('output = "out"\n[[scene]]\nname = "a"\n', "jobs.toml:2: the scene has no source"),
        ('output = "out"\n[[scene]]\nsource = "take"\nname = "a/b"\n', "jobs.toml:4: name = 'a/b': '/' cannot be in"),
        ('output = "out"\n[[scene]]\nsource = "take"\nsize = 1\n', "jobs.toml:4: 'size' is not known"),
        (
            'output = "out"\n[grid]\nquality = 40\n[[scene]]\nsource = "take"\n',
            "jobs.toml:3: quality in the grid is",
        ),
        ('output = "out"\n[options]\npreset = "quick"\n[[scene]]\nsource = "take"\n', "invalid choice: 'quick'"),
        ('output = "out"\n[options]\nwork = "w"\n[[scene]]\nsource = "take"\n', "jobs.toml:3: work: a batch sets"),
        ('output = "out"\n[resources]\ncores = 0\n[[scene]]\nsource = "take"\n', "cores = 0 is not a whole number"),
        ('output = "out"\n[resources]\nmemory = "much"\n[[scene]]\nsource = "take"\n', "'much' is not a size"),
        ('output = "out"\n[[scene]]\nsource = "take"\n[[scene]]\nsource = "take"\n', "jobs.toml:4: the name 'take' is"),
        ("output =\n", "line 1"),
    ],
)
def test_a_fault_is_a_line(
    tmp_path: Path, take: Path, capsys: pytest.CaptureFixture[str], text: str, fault: str
) -> None:
    assert main([str(write(tmp_path, text))]) == 2
    said = capsys.readouterr().err.splitlines()
    assert len(said) == 1 and fault.format(tmp_path) in said[0]
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    "words, fault",
    [
        (["-o", "mine.kpc"], "--output: a batch sets"),
        (["--outp=mine.kpc"], "--output: a batch sets"),
        (["--keep-checkpoint", "mine.kpck"], "--keep-checkpoint: a batch sets"),
        (["--dry-run"], "--dry-run: a batch sets"),
        (["--js"], "--json: a batch sets"),
        (["--help"], "--help and --version: a batch sets"),
    ],
)
def test_words_of_a_batch_are_its_own(
    take: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], words: list[str], fault: str
) -> None:
    assert main([str(take), "-o", str(tmp_path / "out"), "--", *words]) == 2
    said = capsys.readouterr()
    assert said.err.startswith(f"kpbatch: {take}: {fault}") and said.err.count("\n") == 1 and not said.out


def test_an_abbreviated_group_is_one(take: Path) -> None:
    (job,) = jobs.jobs_of_folders([str(take)], ["--gro", "10s"], Resources())
    assert job.group


def test_ctrl_c_leaves_time_to_end_the_workers(monkeypatch: pytest.MonkeyPatch) -> None:
    """Which takes longer than a command has after Ctrl-C unless it has taken note."""
    heard: list[bool] = []
    monkeypatch.setattr(engine.interrupts, "heard", lambda: heard.append(True))
    monkeypatch.setattr(engine, "LocalCluster", lambda **_: contextlib.nullcontext())
    monkeypatch.setattr(engine, "Client", contextlib.nullcontext)
    with engine.local_cluster(1, Resources()):
        assert not heard
    with pytest.raises(KeyboardInterrupt), engine.local_cluster(1, Resources()):
        raise KeyboardInterrupt
    assert heard


def test_all_faults_are_found_at_once(tmp_path: Path, take: Path) -> None:
    text = 'output = "out"\nx = 1\n[options]\npreset = "quick"\n[[scene]]\nsource = "take"\n[[scene]]\nsource = "no"\n'
    with pytest.raises(FaultyBatch) as error:
        jobs.read_jobs(write(tmp_path, text))
    assert len(error.value.faults) == 3


def test_faults_stand_in_the_order_of_the_file_with_all_of_a_scene_whose_source_is_missing(
    tmp_path: Path, take: Path
) -> None:
    shutil.copyfile(SAMPLE, tmp_path / "b.kpc")
    text = (
        '[[scene]]\nsource = "take"\nzebra = 1\nalpha = 2\n[[scene]]\nsource = "no"\nname = "a b"\n'
        'options = { seed = "x" }\nresources = { cores = 0 }\n[[scene]]\nname = "named"\n'
        '[[scene]]\nsource = "b.kpc"\noptions = { quality = 0 }\n[options]\npreset = "quick"\n[more]\n'
    )
    with pytest.raises(FaultyBatch) as error:
        jobs.read_jobs(write(tmp_path, text), str(tmp_path))
    said = [fault.removeprefix(f"{tmp_path}/jobs.toml:").split(": ", 1) for fault in error.value.faults]
    assert [int(line) for line, _ in said] == [3, 4, 6, 7, 8, 9, 10, 12, 14, 16, 17]
    words = (*("zebra", "alpha", "no such file", "name = 'a b'", "--seed", "cores = 0", "no source"),)
    words += ("is the source, too", "--quality", "--preset", "'more' is not known")
    assert all(word in fault for word, (_, fault) in zip(words, said, strict=True))


def test_each_fault_of_an_option_stands_in_its_line(tmp_path: Path, take: Path) -> None:
    """Though the parser of options names only the first, and a grid makes many jobs of it."""
    options = '[options]\npresett = "fast"\nsteps = -4\nquality = 900\n[resources]\ncores = "two"\nram = 1\n'
    text = f'output = "out"\n{options}[grid]\nseed = [1, 2]\nquality = [20, 900]\n[[scene]]\nsource = "take"\n'
    with pytest.raises(FaultyBatch) as error:
        jobs.read_jobs(write(tmp_path, text))
    words = {3: "--presett", 4: "--steps", 7: "cores = 'two'", 8: "'ram' is not", 11: "--quality"}
    said = dict(fault.removeprefix(f"{tmp_path}/jobs.toml:").split(": ", 1) for fault in error.value.faults)
    assert {int(line) for line in said} == set(words) and len(error.value.faults) == len(words)
    assert all(word in said[str(line)] for line, word in words.items())


def test_options_that_exclude_each_other_stand_in_the_line_of_one(tmp_path: Path, take: Path) -> None:
    text = 'output = "out"\n[[scene]]\nsource = "take"\noptions.time_budget = "1m"\noptions.steps = 4\n'
    with pytest.raises(FaultyBatch, match=r"toml:5: --steps and --time-budget both say"):
        jobs.read_jobs(write(tmp_path, text))


def test_a_source_is_never_replaced(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    scene = tmp_path / "a.kpc"
    shutil.copyfile(SAMPLE, scene)
    assert main([str(scene), "-o", str(tmp_path), "--", "--quality", "20"]) == 2
    assert capsys.readouterr().err == f"kpbatch: {scene}: {scene}: is the source, too; write elsewhere with -o\n"
    other = Job("a", "s3://place/a.kpc")  # whose result would replace the source of another job, too
    with pytest.raises(FaultyBatch, match="is the source, too"):
        jobs.check_results(jobs.Batch((Job("a", "s3://place/folder"), replace(other, name="b")), "s3://place"))
    jobs.check_results(jobs.Batch((other, Job("b", str(scene))), str(tmp_path / "out")))


def test_places_that_cannot_be_written_are_named_with_their_option(
    tmp_path: Path, take: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "locked").mkdir()
    access = os.access
    monkeypatch.setattr(os, "access", lambda path, mode: Path(path).name != "locked" and access(path, mode))
    monkeypatch.chdir(tmp_path)
    for *words, option, path in ["-o", "locked/out"], ["-o", "out", "--scratch", "locked"]:
        assert main([str(take), *words, option, path]) == 1
        assert f"{path}: no permission to write there; choose another place with {option}" in capsys.readouterr().err


def test_only_pages_of_its_own_are_replaced(tmp_path: Path, take: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "out"
    summary.write_report((), {}, Store(str(out)))
    summary.check_report(Store(str(out)))
    (out / "report.html").write_text("<title>Our report</title>")
    assert main([str(take), "-o", str(out), "--dry-run"]) == 2
    assert "report.html: is no page of kpbatch and stays" in capsys.readouterr().err


def test_an_empty_folder_is_refused_before_anything_starts(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "empty").mkdir()
    assert main([str(tmp_path / "empty"), "-o", str(tmp_path / "out")]) == 2
    assert "empty directory" in capsys.readouterr().err and not (tmp_path / "out").exists()


def test_files_that_cannot_be_coded_are_refused_before_anything_starts(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    sample = SAMPLE.read_bytes()
    (tmp_path / "none.kpc").touch()
    (tmp_path / "cut.kpc").write_bytes(sample[:-1])
    (tmp_path / "whole.kpc").write_bytes(sample)
    os.mkfifo(tmp_path / "pipe.kpc")
    names = [str(tmp_path / f"{name}.kpc") for name in ("none", "cut", "whole", "pipe")]
    assert main([*names, "-o", str(tmp_path / "out"), "--dry-run"]) == 2
    said = capsys.readouterr().err.splitlines()
    assert [line.split(": ")[1] for line in said] == [names[0], names[1], names[3]]
    assert "nor a .kpc file" in said[0] and "cut off at" in said[1] and "is a pipe" in said[2]
    assert said[1].count("cut.kpc") == 1
    assert main([names[2], "-o", str(tmp_path / "out"), "--dry-run"]) == 0 and not (tmp_path / "out").exists()


def chunk_at(offset: int) -> int:
    """Return the number of the sample's chunk that holds a byte."""
    index = Reader(SAMPLE.read_bytes()).index
    (number,) = (n for n, entry in enumerate(index) if entry.offset <= offset < entry.offset + entry.stored_length)
    return number


def test_a_dry_run_names_each_damaged_file_once(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Though a grid makes two jobs of it; encoding begins without reading files as a whole."""
    data = bytearray(SAMPLE.read_bytes())
    data[20_000] ^= 1
    (tmp_path / "broken.kpc").write_bytes(data)
    text = '[grid]\nquality = [20, 30]\n[[scene]]\nsource = "none"\n[[scene]]\nsource = "broken.kpc"\n'
    file = write(tmp_path, text)
    for words in [str(file)], [str(tmp_path / "none"), str(tmp_path / "broken.kpc")]:
        assert main([*words, "-o", str(tmp_path / "out"), "--dry-run"]) == 2
        missing, damaged = capsys.readouterr().err.splitlines()
        assert "no such file" in missing and "damaged" not in missing
        assert f"chunk {chunk_at(20_000)} (PLNE) is damaged" in damaged
    assert damaged.startswith(f"kpbatch: {tmp_path / 'broken.kpc'}: chunk") and not (tmp_path / "out").exists()
    with pytest.raises(FaultyBatch) as error:
        jobs.read_jobs(file, str(tmp_path / "out"))
    assert len(error.value.faults) == 1


def test_what_kpenc_would_refuse_at_once_is_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for name in ("takes/a/x.mp4", "takes/b/x.mp4", "takes/b/y.mp4", "notes.txt"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text("no video")
    for name, said in ("takes", "two videos are named x; give"), ("notes.txt", "neither a folder of videos"):
        words = [str(tmp_path / name), "-o", str(tmp_path / "out"), "--dry-run", "--", "--preset", "draft"]
        assert main(words) == 2
        (fault,) = capsys.readouterr().err.splitlines()
        assert fault.startswith(f"kpbatch: {tmp_path / name}: {said}")


def test_a_plan_as_json_is_a_line_for_each_job_and_a_sum(
    tmp_path: Path, take: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """In a folder that -o names, which the file of jobs need not do."""
    file = write(tmp_path, '[[scene]]\nsource = "take"\n')
    assert main([str(file), "-o", str(tmp_path / "out"), "--json", "--dry-run"]) == 0
    first, last = map(json.loads, capsys.readouterr().out.splitlines())
    assert (first["job"], first["state"], first["source"]) == ("take", "waits", str(take))
    assert last == {"jobs": 1, "done": 0}
    assert jobs.read_jobs(file, "s3://place").output == "s3://place"


def test_folders_of_one_name_are_refused_with_a_remedy_of_the_command_line(tmp_path: Path, take: Path) -> None:
    shutil.copytree(take, tmp_path / "other" / "take")
    with pytest.raises(FaultyBatch, match=r"other/take: the name 'take' is taken by .*; name them in a file of jobs"):
        jobs.jobs_of_folders([str(take), str(tmp_path / "other" / "take")], [], Resources())


def test_an_address_follows_content_options_and_group(take: Path) -> None:
    def keys(options: tuple[str, ...]) -> list[str]:
        source_address.cache_clear()
        job = Job("take", str(take), options, group=True)
        return [task.key for task in (*first_tasks([job]), *tasks_of_groups(job, 2))]

    before = keys(("--seed=1", "--quality=40"))
    assert len({*before}) == 4
    assert keys(("--quality=40", "--seed=1")) == before
    assert not {*before} & {*keys(("--quality=50", "--seed=1"))}
    (take / ".DS_Store").write_bytes(b"hidden")
    assert keys(("--seed=1", "--quality=40")) == before
    (take / "cam00.mp4").write_bytes(b"two")
    assert not {*before} & {*keys(("--seed=1", "--quality=40"))}


def test_a_result_that_is_a_link_is_written_where_it_leads(tmp_path: Path) -> None:
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "take.json").symlink_to("../master.json")
    Store(str(tmp_path / "out")).put_text("{}", "take.json")
    assert (tmp_path / "out" / "take.json").is_symlink() and (tmp_path / "master.json").read_text() == "{}"


@pytest.mark.parametrize("address", ["{}", "file://{}", "memory://{}", "s3"])
def test_a_store_holds_whole_files(tmp_path: Path, address: str, request: pytest.FixtureRequest) -> None:
    place = request.getfixturevalue("bucket") if address == "s3" else address.format(tmp_path / "store")
    store, file = Store(place), tmp_path / "file"
    file.write_bytes(b"content")
    store.put(file, f"key/{WORK}/deep/a")
    store.put_json({"a": 1}, "key/result.json")
    store.copy(f"key/{WORK}/deep/a", "other")
    assert store.names("*/result.json") == ["key/result.json"] and store.get_json("key/result.json") == {"a": 1}
    assert store.get_folder(f"key/{WORK}", tmp_path / "back") and not store.get_folder("none", tmp_path / "none")
    assert (tmp_path / "back/deep/a").read_bytes() == b"content" and store.exists("other")
    with pytest.raises(StoreError, match="no such file"):
        store.put(tmp_path / "missing", "key/b")
    assert store.names("key/*") == ["key/result.json", f"key/{WORK}"]
    store.remove("key")
    store.remove("key")
    assert not store.exists("key/result.json")


def test_a_batch_reads_and_writes_addresses(bucket: str, scene_file: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A file at an address is coded again by a worker process, its result written there, and not made again."""
    fs, root = fsspec.core.url_to_fs(bucket)
    fs.put_file(str(scene_file), f"{root}/in/take.kpc")
    command = [
        f"{bucket}/in/take.kpc",
        "-o",
        f"{bucket}/out",
        "--workers",
        "1",
        "--",
        "--quality",
        "20",
        "--tune-steps",
        "0",
    ]
    assert main(command) == 0, capsys.readouterr()
    written = fs.info(f"{root}/out/take.kpc")
    assert 0 < written["size"] < scene_file.stat().st_size
    assert json.loads(fs.cat_file(f"{root}/out/take.json"))["size_bytes"] == written["size"]
    assert main(command) == 0
    assert fs.info(f"{root}/out/take.kpc")["LastModified"] == written["LastModified"]


def test_a_store_that_needs_credentials_is_one_line(bucket: str, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("AWS_ACCESS_KEY_ID", "AWS_SECRET_ACCESS_KEY"):
        monkeypatch.delenv(name)
    fsspec.get_filesystem_class("s3").clear_instance_cache()
    with pytest.raises(StoreError, match=r"^s3://.*redentials") as error:
        Store(bucket).put_text("text", "name")
    assert "\n" not in str(error.value)


def test_a_store_of_an_unknown_kind_is_one_line() -> None:
    with pytest.raises(StoreError, match="nonsense"):
        Store("nonsense://place")


def test_a_damaged_result_says_what_to_do(tmp_path: Path) -> None:
    (tmp_path / "key").mkdir()
    (tmp_path / "key" / RESULT).write_text("{")
    with pytest.raises(StoreError, match="delete it"):
        done_before(Store(str(tmp_path)))


def task(number: int = 0, before: tuple[str, ...] = (), **more: Any) -> Task:
    return Task(f"key{number}", f"task {number}", f"job{number}", ENCODE, before=before, **more)


def counting(task: Task, place: Place, report: Report) -> Outcome:
    """Write a line for each call; fail where the options say so."""
    with Path(place.store, "calls").open("a") as calls:
        calls.write(f"{task.key}\n")
    failures = int(task.words[0]) if task.words else 0
    if Path(place.store, "calls").read_text().split().count(task.key) <= failures:
        return Outcome(task.key, False, error="it failed")
    report({"percent": 50.0})
    return Outcome(task.key, True, {"number": 1}, worker="a worker")


def outcomes(client: Client, place: Path, tasks: list[Task], runner: engine.Runner = counting) -> list[Event]:
    made = Engine(lambda: client, Place(str(place)), runner)
    made.add(tasks)
    return list(made.events())


def calls(place: Path) -> list[str]:
    return (place / "calls").read_text().split()


def test_tasks_follow_those_that_they_need(threads: Client, tmp_path: Path) -> None:
    tasks = [task(2, ("key0", "key1")), task(0), task(1)]
    events = outcomes(threads, tmp_path, tasks)
    assert [event.task.key for event in events if event.kind == "done"][-1] == "key2"
    assert sorted(calls(tmp_path)) == ["key0", "key1", "key2"] and calls(tmp_path)[-1] == "key2"


def test_a_task_that_fails_is_tried_once_more_and_others_end(threads: Client, tmp_path: Path) -> None:
    tasks = [task(0, words=("1",)), task(1, words=("2",)), task(2, ("key1",)), task(3)]
    ended = {event.task.key: event.kind for event in outcomes(threads, tmp_path, tasks) if event.kind != "runs"}
    assert ended == {"key0": "done", "key1": "failed", "key2": "failed", "key3": "done"}
    assert sorted(calls(tmp_path)) == ["key0", "key0", "key1", "key1", "key3"]


def test_tasks_that_are_done_are_not_done_again_and_need_no_cluster(tmp_path: Path) -> None:
    made = Engine(lambda: pytest.fail("a cluster was made"), Place(str(tmp_path)), counting)
    made.know({"key0": Outcome("key0", True)})
    made.add([task(0), task(0)])
    assert [event.kind for event in made.events()] == ["done", "done"]


def test_many_tasks_are_done_once_each(threads: Client, tmp_path: Path) -> None:
    events = outcomes(threads, tmp_path, [task(number) for number in range(200)])
    assert sum(event.kind == "done" for event in events) == 200
    assert len(calls(tmp_path)) == len(set(calls(tmp_path))) == 200


def test_a_job_larger_than_any_worker_is_one_line(threads: Client, tmp_path: Path) -> None:
    with pytest.raises(engine.ClusterError, match='--resources "cores=3"'):
        outcomes(threads, tmp_path, [task(0, resources=Resources(cores=3))])


@pytest.mark.parametrize(
    "words, said",
    [
        (["--scheduler", "foo"], "'foo' is no address of a scheduler, such as tcp://head:8786"),
        (["--scheduler", "tcp://head:none"], "is no address of a scheduler"),
        (["--memory", "1"], "'1' is less than any job takes"),
    ],
)
def test_what_no_job_can_run_on_is_refused(
    take: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], words: list[str], said: str
) -> None:
    with pytest.raises(SystemExit):
        main([str(take), "-o", str(tmp_path / "out"), "--dry-run", *words])
    assert said in capsys.readouterr().err


def test_a_scheduler_that_is_not_there_is_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(engine, "CONNECT_S", 0.2)
    with (
        pytest.raises(engine.ClusterError, match="no Dask scheduler answers"),
        engine.remote_cluster("tcp://127.0.0.1:9"),
    ):
        pass


def test_a_dry_run_says_whether_the_scheduler_answers(
    threads: Client, take: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    address = threads.scheduler.address
    kpbatch._try_scheduler(address, [Job("a", "s3://place/a")])
    assert capsys.readouterr().err == f"kpbatch: {address}: the scheduler answers, and has 2 workers\n"
    with pytest.raises(engine.ClusterError, match='--resources "cores=3"'):
        kpbatch._try_scheduler(address, [Job("a", "s3://place/a", resources=Resources(cores=3))])
    monkeypatch.setattr(engine, "TRY_S", 0.2)
    assert main([str(take), "-o", str(tmp_path / "out"), "--dry-run", "--scheduler", "127.0.0.1:9"]) == 1
    said = capsys.readouterr()
    assert "to do take" in said.out and said.err.count("\n") == 1
    assert said.err.startswith("kpbatch: 127.0.0.1:9: no Dask scheduler answers")


def test_a_server_that_is_no_scheduler_is_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    def client(*_: object, **__: object) -> None:
        raise MemoryError("Unable to allocate 3.07 EiB")  # the first bytes of HTTP/1.1 are a size for Dask

    monkeypatch.setattr(engine, "Client", client)
    with pytest.raises(engine.ClusterError, match="no Dask scheduler answers"):
        engine.count_workers("tcp://127.0.0.1:80", [])


def in_steps(task: Task, place: Place, report: Report) -> Outcome:
    """Do ten steps, each kept in the store, beginning where another worker was killed."""
    store = Store(place.store)
    for step in range(len(store.names(f"{task.key}/step*")), 10):
        Path(place.store, f"{task.key}.{step}.{os.getpid()}").touch()
        time.sleep(0.1)
        store.put_json(step, f"{task.key}/step{step}")
    store.put_json({}, f"{task.key}/{RESULT}")
    return Outcome(task.key, True, worker=str(os.getpid()))


def test_a_worker_that_is_killed_is_replaced_and_its_task_goes_on(tmp_path: Path) -> None:
    killed: list[int] = []
    with engine.local_cluster(2, Resources()) as client:
        made = Engine(lambda: client, Place(str(tmp_path)), in_steps)
        made.add([task(number) for number in range(3)])
        done = []
        for event in made.events():
            done += [event.task.key] * (event.kind == "done")
            begun = sorted(tmp_path.glob("key0.3.*"))
            if begun and not killed:
                killed.append(int(begun[0].name.rsplit(".", 1)[1]))
                os.kill(killed[0], signal.SIGKILL)
    steps = [file.name.split(".")[:2] for file in tmp_path.glob("key?.*")]
    assert sorted(done) == ["key0", "key1", "key2"] and killed
    assert len(Store(str(tmp_path)).names("*/step*")) == 30
    assert 30 <= len(steps) <= 32  # at most the step of each task that the killed worker was in is done twice


def in_steps_without_ctrl_c(task: Task, place: Place, report: Report) -> Outcome:
    """Do ten steps in a process that Ctrl-C does not reach."""
    assert signal.SIGINT in signal.pthread_sigmask(signal.SIG_BLOCK, ())
    return in_steps(task, place, report)


class Killer(Engine):
    """Kills the worker of the first task that is done before its outcome is asked for."""

    killed = 0

    def _wait(self) -> list[Future]:
        done = super()._wait()
        if done and not self.killed:
            self.killed = int(done[0].result().worker)
            os.kill(self.killed, signal.SIGKILL)
            while done[0].status == "finished":
                time.sleep(0.01)
        return done


def test_an_outcome_that_is_lost_with_its_worker_is_waited_for_again(tmp_path: Path) -> None:
    """Neither the first worker nor the one that replaces it gets the Ctrl-C of a terminal, by which kpbatch ends."""
    with engine.local_cluster(1, Resources()) as client:
        made = Killer(lambda: client, Place(str(tmp_path)), in_steps_without_ctrl_c)
        made.add([task(0)])
        assert [event.kind for event in made.events() if event.kind != "runs"] == ["waits", "done"]
    assert len(list(tmp_path.glob("key?.*"))) == 10


def test_a_scheduler_that_is_killed_is_one_line_and_another_goes_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(engine, "CONNECT_S", 5)
    address, tasks = tmp_path / "scheduler.json", [task(number) for number in range(3)]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([str(Path(__file__).parent), *sys.path])}
    programs = []
    for name, *words in (
        ("dask_scheduler", "--host", "127.0.0.1", "--port", "0", "--no-dashboard"),
        ("dask_worker", "--nthreads", "1", "--no-nanny", "--no-dashboard", "--local-directory", str(tmp_path / "work")),
    ):
        command = [sys.executable, "-m", f"distributed.cli.{name}", "--scheduler-file", str(address), *words]
        programs.append(subprocess.Popen(command, env=environment, stderr=subprocess.DEVNULL))
    scheduler, worker = programs

    def kill_at_step_3() -> None:
        while worker.poll() is None and not (tmp_path / f"key0.3.{worker.pid}").exists():
            time.sleep(0.01)
        scheduler.kill()

    try:
        while not address.exists():
            assert scheduler.poll() is None
            time.sleep(0.1)
        with (
            pytest.raises(engine.ClusterError, match="run the same command to go on"),
            engine.remote_cluster(json.loads(address.read_text())["address"]) as client,
        ):
            made = Engine(lambda: client, Place(str(tmp_path)), in_steps)
            made.add(tasks)
            threading.Thread(target=kill_at_step_3).start()
            list(made.events())
    finally:
        for program in programs:
            program.kill()
            program.wait()
    assert len(list(tmp_path.glob("key?.*"))) < 30
    with engine.local_cluster(1, Resources()) as client:
        made = Engine(lambda: client, Place(str(tmp_path)), in_steps)
        made.know(done_before(Store(str(tmp_path))))
        made.add(tasks)
        assert sorted(event.task.key for event in made.events() if event.kind == "done") == ["key0", "key1", "key2"]
    assert len(Store(str(tmp_path)).names("*/step*")) == 30
    assert 30 <= len(list(tmp_path.glob("key?.*"))) <= 31  # the step in which the worker ended may be done twice


@pytest.mark.parametrize("status", ["finished", "error"])
def test_a_connection_that_breaks_before_an_outcome_has_come_is_one_line(tmp_path: Path, status: str) -> None:
    class Lost:
        def result(self) -> None:
            raise CancelledError

        exception = result

    lost: Any = Lost()
    lost.status = status
    with pytest.raises(engine.ClusterError, match="run the same command to go on"):
        Engine(lambda: lost, Place(str(tmp_path)))._outcome_of(lost, task(0))


def test_a_child_ends_with_its_worker(tmp_path: Path) -> None:
    code = (
        "import subprocess, sys, os, time\n"
        "child = subprocess.Popen([sys.executable, '-c', 'import sys, time; from kpc.tools.batch import child; "
        "child.commands.kpenc = lambda words: time.sleep(60) or 0; sys.exit(child.main(sys.argv[1:]))', "
        "str(os.getpid()), 'kpenc'])\n"
        "print(child.pid, flush=True)\n"
        "time.sleep(60)\n"
    )
    worker = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True)
    assert worker.stdout is not None
    child = int(worker.stdout.readline())
    worker.kill()
    worker.wait()
    worker.stdout.close()
    for _ in range(300):
        if not is_running(child):
            return
        time.sleep(0.1)
    os.kill(child, signal.SIGKILL)
    pytest.fail("the child goes on")


def is_running(pid: int) -> bool:
    """Return whether a process exists that has not ended yet."""
    try:
        os.kill(pid, 0)
        return Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0] != "Z"
    except (ProcessLookupError, FileNotFoundError):
        return False


def test_changed_files_of_a_work_folder_reach_the_store(tmp_path: Path) -> None:
    work, store = tmp_path / "work", Store(str(tmp_path / "store"))
    for name in ("group-0000", "pixels-2"):
        (work / name).mkdir(parents=True)
    for name in ("group-0000/checkpoint.kpck", "pixels-1.bin", "pixels-2/0000.bin", ".checkpoint.tmp"):
        (work / name).write_bytes(b"1")
    uploads = working.Uploads(work, store, f"key/{WORK}")
    uploads.run()
    assert store.names(f"key/{WORK}/*") == [f"key/{WORK}/group-0000"]
    assert store.names(f"key/{WORK}/*/*") == [f"key/{WORK}/group-0000/checkpoint.kpck"]
    store.remove(f"key/{WORK}/group-0000/checkpoint.kpck")
    uploads.run()
    assert not store.exists(f"key/{WORK}/group-0000/checkpoint.kpck")
    (work / "group-0000/checkpoint.kpck").write_bytes(b"22")
    uploads.run()
    assert store.exists(f"key/{WORK}/group-0000/checkpoint.kpck")


def test_progress_is_what_the_log_says_of_it(tmp_path: Path) -> None:
    log = tmp_path / "log"
    log.write_text(
        "training: 40 %, 12 s left, step 1,200, 27.5 dB, 30 rays/s\n"
        "channels kept: 8 of 8, a loss of 0.001 dB, 0.1 allowed\n"
    )
    assert working._progress(log) == {"percent": 40, "left_s": 12, "psnr": 27.5}
    log.write_text("channels kept: 8 of 8, a loss of 0.001 dB, 0.1 allowed\n")
    assert working._progress(log) == {}


def test_failures_are_listed_and_what_is_done_is_published(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    broken, out = tmp_path / "broken.kpc", tmp_path / "out"
    data = bytearray(SAMPLE.read_bytes())
    data[20_000] ^= 1
    broken.write_bytes(data)
    options = ["--quality", "20"]
    (done,) = first_tasks(jobs.jobs_of_folders([str(SAMPLE)], options, Resources()))
    store = Store(f"{out}/.kpbatch")
    store.put(SAMPLE, f"{done.key}/{SCENE}")
    store.put_json({"size_bytes": 57_243, "test_psnr": 33.7}, f"{done.key}/{RESULT}")
    assert main([str(SAMPLE), str(broken), "-o", str(out), "--workers", "1", "--", *options]) == 1
    said = capsys.readouterr()
    assert re.search(rf"broken failed:\n.*broken.kpc: chunk {chunk_at(20_000)} \(PLNE\) ", said.out)
    assert "1 of 2 jobs failed" in said.err
    assert re.search(r"^default +57,243 +33.70 ", said.out, re.MULTILINE)
    assert (out / "default.kpc").read_bytes() == SAMPLE.read_bytes()
    assert json.loads((out / "default.json").read_text())["key"] == done.key
    page = (out / "report.html").read_text()
    assert "1 of 2 jobs done" in page and 'href="default.kpc"' in page and "://" not in page
    (out / "default.kpc").unlink()
    assert main([str(SAMPLE), "-o", str(out), "--", *options]) == 0
    assert (out / "default.kpc").exists()


def test_parts_of_a_clip_are_joined(tmp_path: Path) -> None:
    store = Store(str(tmp_path))
    for number in range(2):
        store.put(SAMPLE, f"key{number}/{SCENE}")
        store.put_json(
            {"test_psnr": 30.0 + 4 * number, "test_pictures": 3 - 2 * number, "steps": 5}, f"key{number}/{RESULT}"
        )
    joined = Task("joined", "clip", "clip", "join", before=("key0", "key1"))
    outcome = working.run(joined, Place(str(tmp_path), str(tmp_path / "scratch")))
    assert outcome.is_done and outcome.figures["groups"] == 2, outcome.error
    assert outcome.figures["test_psnr"] == 31.0 and outcome.figures["steps"] == 10
    assert outcome.figures["test_ssim"] is None
    assert not list((tmp_path / "scratch/kpbatch").glob("task-*"))


def test_a_full_disk_is_a_failure_of_its_task(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    store = Store(str(tmp_path / "store"))
    store.put(SAMPLE, f"key0/{SCENE}")
    store.put_json({}, f"key0/{RESULT}")

    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(fsspec.get_filesystem_class("file"), "put_file", full)
    joined = Task("joined", "clip", "clip", "join", before=("key0",))
    outcome = working.run(joined, Place(str(tmp_path / "store"), str(tmp_path / "scratch")))
    assert not outcome.is_done and outcome.error.endswith("scene.kpc: No space left on device")
    assert not store.exists(f"joined/{RESULT}")


def test_options_of_folders_are_checked(tmp_path: Path, take: Path) -> None:
    with pytest.raises(FaultyBatch, match=r"'0\.5' is not a whole number from 1 on"):
        jobs.jobs_of_folders([str(take)], ["--test-views", "0.5"], Resources())
    with pytest.raises(UsageError, match="no such"):
        jobs.jobs_of_folders([str(tmp_path / "none")], [], Resources())


def test_the_simulation_counts_what_failures_cost() -> None:
    calm = simulation.Model(scenes=40, workers=4, bad=0.0, failure_s=1e12, input_bytes=0.0, message_s=0.0)
    found = simulation.simulate(calm)
    assert found.failures == 0 and found.redone_s == 0 and found.link == found.scheduler == 0
    assert 0.8 < found.efficiency <= 1 + 1e-9
    alone = simulation.simulate(replace(calm, workers=1))
    assert alone.efficiency == pytest.approx(1) and alone.seconds < 4 * found.seconds
    failing = simulation.simulate(replace(calm, failure_s=1800.0))
    assert failing.failures > 5 and failing.seconds > found.seconds
    assert 0 < failing.redone_s <= failing.failures * calm.checkpoint_s
