import os
import threading
import time

import pytest
import torch

from rf3dgs.core.threads import on_threads, one_torch_thread, thread_count


@pytest.fixture
def three_threads(monkeypatch: pytest.MonkeyPatch, torch_threads):
    monkeypatch.delenv("RF3DGS_THREADS", raising=False)
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: set(range(8)), raising=False)


def test_torch_is_kept_to_one_thread_and_the_core_is_not(three_threads):
    with one_torch_thread(), one_torch_thread():
        assert (torch.get_num_threads(), thread_count()) == (1, 3)
    assert (torch.get_num_threads(), thread_count()) == (3, 3)


def test_an_error_gives_the_threads_back(three_threads):
    with pytest.raises(ZeroDivisionError), one_torch_thread():
        raise ZeroDivisionError
    assert (torch.get_num_threads(), thread_count()) == (3, 3)


def test_items_share_the_threads_and_keep_their_order(three_threads):
    names = set()

    def work(item: int) -> tuple[int, int, int]:
        time.sleep(0.01 * (5 - item % 5))
        names.add(threading.current_thread().name)
        return item, torch.get_num_threads(), thread_count()

    assert on_threads(work, range(12)) == [(item, 1, 1) for item in range(12)]
    assert 1 < len(names) <= 3
    assert torch.get_num_threads() == 3


def test_an_error_of_one_item_is_raised(three_threads):
    with pytest.raises(ValueError, match="item 3"):
        on_threads(lambda item: int("item 3" if item == 3 else item), range(5))
