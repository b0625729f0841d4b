"""Work that is shared out among cores."""

import threading

import pytest

from kpc.player.cpu import threads
from kpc.player.cpu.threads import from_both_ends, share_out


@pytest.mark.parametrize("count", [0, 1, 2, 7, 1000])
@pytest.mark.parametrize("among", [1, 2, 3, 8])
def test_every_part_is_done_once(count: int, among: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(threads, "CORES", among)
    done, parts = [0] * count, []

    def work(part: slice) -> None:
        parts.append(part)
        for number in range(*part.indices(count)):
            done[number] += 1

    share_out(work, count)
    assert done == [1] * count and len(parts) == min(among, count)


def test_an_error_in_any_part_is_raised(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(threads, "CORES", 2)
    for wrong in (0, 5):

        def work(part: slice, wrong: int = wrong) -> None:
            if part.start == wrong:
                raise ValueError(threading.current_thread().name)

        with pytest.raises(ValueError):
            share_out(work, 10)


@pytest.mark.parametrize("count", [0, 1, 15, 16, 1000])
@pytest.mark.parametrize("among", [1, 2, 3, 8])
def test_from_both_ends_every_part_is_done_once_and_is_large_enough(
    count: int, among: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(threads, "WORKERS", among)
    done, parts = [0] * count, []

    def work(worker: int, part: slice) -> None:
        parts.append((worker, part))
        for number in range(*part.indices(count)):
            done[number] += 1

    from_both_ends(work, count, 16)
    assert done == [1] * count and {worker for worker, _ in parts} <= set(range(among))
    assert all(part.stop - part.start >= min(16, count) for _, part in parts)


def test_workers_meet_in_the_middle(monkeypatch: pytest.MonkeyPatch) -> None:
    """So that the parts of each lie side by side, however long each takes."""
    monkeypatch.setattr(threads, "WORKERS", 2)
    taken: dict[int, list[int]] = {0: [], 1: []}
    from_both_ends(lambda worker, part: taken[worker].append(part.start), 320, 10)
    assert taken[0] == sorted(taken[0]) and taken[1] == sorted(taken[1], reverse=True)
    assert not taken[0] or not taken[1] or max(taken[0]) < min(taken[1])


def test_an_error_at_either_end_is_raised(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(threads, "WORKERS", 2)
    for wrong in (0, 310):

        def work(worker: int, part: slice, wrong: int = wrong) -> None:
            if part.start <= wrong < part.stop:
                raise ValueError(worker)

        with pytest.raises(ValueError):
            from_both_ends(work, 320, 10)
