"""A reader reads any damaged file or refuses it with a FormatError."""

import json
import os
import random
import shutil
import signal
import time

import pytest
import zstandard
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from kpc.format.common.errors import FormatError
from kpc.format.container.scene_io import read
from kpc.tools.vectors import fuzz, fuzz_bodies, specvectors, web_reader
from kpc.tools.vectors.files import encode
from kpc.tools.vectors.scenes import minimal_scene
from kpc.tools.vectors.web_reader import WebReader

FEW = settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.too_slow, HealthCheck.data_too_large])


@pytest.fixture(scope="module")
def starts() -> list[fuzz.Taken]:
    return fuzz.seeds()


@pytest.fixture(scope="module")
def minimal() -> bytes:
    return encode(minimal_scene())


def test_a_file_taken_apart_and_put_together_is_the_same(starts, minimal):
    assert fuzz.Taken.of(minimal).together() == minimal
    assert all(fuzz.examined(taken.together()) in ("read", "FormatError") for taken in starts)
    assert sum(fuzz.examined(taken.together()) == "read" for taken in starts) > 30


@pytest.mark.parametrize("name", fuzz.MUTATIONS)
@given(rng=st.randoms(use_true_random=False))
@FEW
def test_damage_of_every_kind_is_read_or_refused(starts, name, rng):
    fuzz.examined(fuzz.MUTATIONS[name](rng, rng.choice(starts), starts))


def test_damage_gets_past_the_checksums(starts):
    """Mutated content is read or refused by its decoder, never by a checksum."""
    said = []
    for number in range(150):
        rng = random.Random(number)
        data = fuzz.in_content(rng, starts[0], starts)
        try:
            read(data)
            said.append("read")
        except FormatError as error:
            said.append(str(error))
    assert said.count("read") > 10 and len(set(said)) > 15
    assert not any("CRC32C" in message for message in said)


def test_every_truncation_of_a_small_file_is_refused(minimal):
    for length in range(len(minimal)):
        with pytest.raises(FormatError):
            read(minimal[:length])
        fuzz.examined(minimal[:length])


def test_every_bit_flip_of_a_small_file_is_refused(minimal):
    for bit in range(8 * len(minimal)):
        damaged = bytearray(minimal)
        damaged[bit >> 3] ^= 1 << (bit & 7)
        with pytest.raises(FormatError):
            read(bytes(damaged))


def test_the_command_counts_and_keeps_what_it_finds(monkeypatch, tmp_path, capsys):
    monkeypatch.setattr(fuzz, "run", lambda *args, **more: {"count": 3, "findings": [(2, "ValueError: no")]})
    assert fuzz.main(["--count", "3", "--seed", "5", "-o", str(tmp_path / "found")]) == 1
    said = capsys.readouterr()
    assert json.loads(said.out)["count"] == 3 and "1 of 3 files" in said.err
    assert (tmp_path / "found" / "5-2.kpc").read_bytes() == fuzz.file_number(5, 2, fuzz.seeds())


def test_a_browser_player_that_does_not_answer_is_ended(minimal, monkeypatch):
    if shutil.which("node") is None:
        pytest.skip("needs node")
    reader = WebReader(fuzz.WEB_BUDGET)
    try:
        monkeypatch.setattr(web_reader, "SILENT_S", 0.2)
        reader._process.send_signal(signal.SIGSTOP)
        with pytest.raises(AssertionError, match="no answer"):
            reader.examined(minimal, fuzz.HANG_S)
        monkeypatch.setattr(web_reader, "SILENT_S", 60.0)
        assert reader.examined(minimal, fuzz.HANG_S) == "read"
    finally:
        reader.close()


def test_the_browser_player_reads_or_refuses_what_is_damaged(minimal):
    if shutil.which("node") is None:
        pytest.skip("needs node")
    reader, starts = WebReader(fuzz.WEB_BUDGET), fuzz.seeds("minimal,groups,dynamic")
    try:
        assert reader.examined(minimal, fuzz.HANG_S) == "read"
        assert reader.examined(minimal[:-1], fuzz.HANG_S) == "FormatError"  # its only scale makes no picture
        dynamic = specvectors.files()["valid/dynamic.kpc"]
        assert reader.examined(dynamic[:-1], fuzz.HANG_S) == "read"  # as far as it goes
        assert reader.examined(b"not one", fuzz.HANG_S) == "FormatError"
        said = {reader.examined(fuzz.file_number(1, number, starts), fuzz.HANG_S) for number in range(40)}
        assert said == {"read", "FormatError"}
        with pytest.raises(AssertionError, match="took"):
            reader.examined(minimal, 0.0)
        reader._process.kill()
        with pytest.raises((AssertionError, OSError)):
            reader.examined(minimal, fuzz.HANG_S)
    finally:
        reader.close()


def test_vectors_by_name():
    assert 0 < len(fuzz.seeds("transform,motion")) < len(fuzz.seeds()) / 4
    assert fuzz.main(["--count", "1", "--only", "nothing-is-called-so"]) != 0


def breaks(data: bytes, budget: int = 0) -> str:
    raise ValueError("as it should not")


def test_other_errors_are_found_and_work_goes_on(monkeypatch):
    sent: list = []
    monkeypatch.setattr(fuzz, "_limit_memory", lambda more: monkeypatch.setattr(fuzz, "examined", breaks))
    pipe = type("Pipe", (), {"send": staticmethod(sent.append)})
    fuzz._work(pipe, [0.0, 0.0, 0.0], 1, range(3), frozenset({1}), fuzz.BUDGET, "")
    ((following, tally, findings),) = sent
    assert following == 3 and tally == {"finding": 2}
    assert findings == [(0, "ValueError: as it should not"), (2, "ValueError: as it should not")]


def test_processes_of_their_own():
    found = fuzz.run(4, seed=3, processes=1)
    assert found["count"] == 4 and not found["findings"]


def test_a_run_in_parts(monkeypatch):
    """Two parts examine what the whole does; each process takes every other of them."""
    asked: list[range] = []

    class Process:
        pid, exitcode = 0, 0

        def __init__(self, target, args, daemon):
            self.pipe, _, _, self.numbers, *_ = args

        def start(self):
            asked.append(self.numbers)
            self.pipe.send((self.numbers.stop, fuzz.Counter(read=len(self.numbers)), []))

        def join(self):
            pass

    context = fuzz.multiprocessing.get_context("spawn")
    monkeypatch.setattr(type(context), "Process", Process)
    parts = [fuzz.run(count, seed=1, processes=2, first=first) for first, count in ((0, 5), (5, 4), (9, 1))]
    assert [part["count"] for part in parts] == [5, 4, 1]
    assert sorted(number for numbers in asked for number in numbers) == list(range(10))


def test_computing_is_told_of_other_processes():
    assert fuzz._computed_s(os.getpid()) == pytest.approx(time.process_time(), abs=0.2)
    assert fuzz._computed_s(-1) == 0


def test_a_frame_that_says_it_is_vast_is_not_taken_at_its_word() -> None:
    small, vast = (
        zstandard.compress(b"a" * 100),
        b"\x28\xb5\x2f\xfd\xe0" + (1 << 50).to_bytes(8, "little") + b"\x01\x00\x00",
    )
    assert fuzz._decompressed(small) == b"a" * 100
    assert fuzz._decompressed(vast) is None and fuzz._decompressed(b"no frame") is None


def test_bodies_are_decoded_or_refused():
    """The bodies of every codec; each is decoded without a mutation, and number N of a seed is always the same."""
    starts = fuzz_bodies.bodies()
    assert {start.name.split()[-1] for start in starts} == {"PLNE", *fuzz_bodies.FUNCTIONS}
    for start in starts:
        start.decode(start.stored)
    found = fuzz_bodies.run(300, seed=2)
    assert found["count"] == 300 == sum(found["outcomes"].values()) and not found["findings"]
    assert found["outcomes"]["decoded"] > 20
    assert fuzz_bodies.body_number(2, 7, starts)[1] == fuzz_bodies.body_number(2, 7, starts)[1]


def test_what_is_wrong_with_bodies_is_found(monkeypatch, tmp_path, capsys):
    def hangs(body: bytes) -> None:
        monkeypatch.setattr(fuzz_bodies.time, "process_time", lambda: 10.0)

    def breaks(body: bytes) -> None:
        monkeypatch.setattr(fuzz_bodies.time, "process_time", lambda: 0.0)
        raise ValueError("as it should not")

    monkeypatch.setattr(fuzz_bodies.time, "process_time", lambda: 0.0)
    for decode, message in ((breaks, "ValueError: as it should not"), (hangs, "took 10.0 s")):
        monkeypatch.setattr(fuzz_bodies, "bodies", lambda d=decode: [fuzz_bodies.Body("a", b"abc", d)])
        assert fuzz_bodies.main(["--count", "1", "-o", str(tmp_path)]) == 1
        assert f"a: {message}" in capsys.readouterr().out and (tmp_path / "0-0.body").is_file()
