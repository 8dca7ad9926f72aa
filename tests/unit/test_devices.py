from types import SimpleNamespace

import jax
import pytest

from gmijax import devices


@pytest.mark.parametrize(
    ("stats", "peak_mib"), [({"peak_bytes_in_use": 3 << 20}, 5.0), ({}, None)]
)
def test_memory_that_warp_has_beside_jax_counts(
    stats: dict[str, int], peak_mib: float | None, monkeypatch: pytest.MonkeyPatch
):
    device = SimpleNamespace(platform="gpu", device_kind="fake", memory_stats=lambda: stats)
    monkeypatch.setattr(jax, "local_devices", lambda: [device])
    monkeypatch.setattr(devices, "PEAKS_BESIDE_JAX", [lambda: 2 << 20])
    described = devices.describe_device()
    assert described["peak_memory_mib"] == peak_mib
    assert (described["platform"], described["kind"]) == ("gpu", "fake")
    assert described["peak_host_memory_mib"] > 0.0
