"""The shared block as one rank uses it: what belongs to the start, and what does not."""

from __future__ import annotations

import os
import threading
import time

import numpy as np
import pytest

from gmijax.collectives.host import HostExchange
from gmijax.collectives.memory import create_exchange
from gmijax.errors import CollectiveTimeout

LATE_S = 0.5


def test_the_call_after_an_introduction_is_the_first_and_may_take_longer() -> None:
    fd = create_exchange()
    ranks = [
        HostExchange(fd, rank, 2, 4, timeout_s=LATE_S / 4, rendezvous_timeout_s=20 * LATE_S)
        for rank in (0, 1)
    ]
    os.close(fd)

    def gather_late() -> None:
        ranks[1].introduce(np.ones(3, np.float32))
        time.sleep(LATE_S)
        ranks[1].all_gather(np.ones(1, np.float32))

    late = threading.Thread(target=gather_late)
    late.start()
    np.testing.assert_array_equal(ranks[0].introduce(np.zeros(3, np.float32)).sum(1), [0, 3])
    assert ranks[0].all_gather(np.zeros(1, np.float32)).shape == (2, 1)
    late.join()
    with pytest.raises(CollectiveTimeout, match="step 3"):
        ranks[0].all_gather(np.zeros(1, np.float32))
    for rank in ranks:
        rank.close()
