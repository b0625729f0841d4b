"""Work that is shared out among cores."""

import threading

import pytest

from kpc.player import cores
from kpc.player.cores import share_out


@pytest.mark.parametrize("count", [0, 1, 2, 7, 1000])
@pytest.mark.parametrize("among", [1, 2, 3, 8])
def test_all_is_done_once(count: int, among: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cores, "CORES", among)
    done, parts = [0] * count, []

    def work(part: slice) -> None:
        parts.append(part)
        for number in range(*part.indices(count)):
            done[number] += 1

    share_out(work, count)
    assert done == [1] * count and len(parts) == min(among, count)


def test_what_goes_wrong_in_any_part_is_raised(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cores, "CORES", 2)
    for wrong in (0, 5):
        def work(part: slice) -> None:
            if part.start == wrong:
                raise ValueError(threading.current_thread().name)

        with pytest.raises(ValueError):
            share_out(work, 10)
