"""Where the cache is, with and without a home; what is broken in it is removed."""

from __future__ import annotations

import os
import tempfile
from pathlib import Path

import pytest
from supervision import planned

from gmijax.errors import ConfigError
from gmijax.machine.snapshot import detect_machine
from gmijax.runs.cache import (
    cache_folder,
    compilation_cache_dir,
    drop_broken_programs,
    why_temporary,
)


@pytest.fixture
def homeless(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """No HOME, and no user of that number, as in a container; the folder that is left."""

    def nobody() -> Path:
        raise RuntimeError("Could not determine home directory.")

    monkeypatch.setattr(Path, "home", nobody)
    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    return tmp_path / f"gmijax-{os.geteuid()}"


def test_without_a_home_the_cache_is_a_folder_of_this_users_alone(homeless: Path):
    assert compilation_cache_dir() == homeless / "xla"
    assert homeless.stat().st_mode & 0o777 == 0o700
    assert cache_folder() == homeless
    plan = planned(detect_machine(), backend="cpu")
    assert any(f"are kept in {homeless};" in reason for reason in plan.reasons)


@pytest.mark.parametrize("trap", ["file", "open", "link"])
def test_a_temporary_folder_that_others_may_write_is_refused(
    trap: str, homeless: Path, tmp_path: Path
):
    if trap == "file":
        homeless.touch()
    elif trap == "open":
        homeless.mkdir()
        homeless.chmod(0o777)
    else:
        (tmp_path / "theirs").mkdir(mode=0o700)
        homeless.symlink_to(tmp_path / "theirs")
    with pytest.raises(ConfigError, match=r"no home folder .*; set XDG_CACHE_HOME to a folder"):
        cache_folder()


def test_a_folder_that_is_named_needs_no_home(homeless: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("XDG_CACHE_HOME", "/mine")
    assert cache_folder() == Path("/mine/gmijax")
    assert why_temporary() is None
    assert not homeless.exists()


def test_the_cache_is_in_a_home_that_can_be_written(
    homeless: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(Path, "home", lambda: Path("/proc/nowhere"))
    assert cache_folder() == homeless
    monkeypatch.setattr(Path, "home", lambda: tmp_path)
    assert cache_folder() == tmp_path / ".cache" / "gmijax"
    assert why_temporary() is None


def test_programs_that_could_not_be_read_are_removed(tmp_path: Path):
    cache, log = tmp_path / "cache", tmp_path / "stderr.log"
    cache.mkdir()
    for name in ("jit_step-0a-cache", "jit_step-0b-cache", "jit_step_two-0c-cache"):
        (cache / name).touch()
    log.write_text(
        "x.py:782: UserWarning: Error reading persistent compilation cache entry for 'jit_step': "
        "ZstdError: zstd decompress error\n  warnings.warn(\n"
    )
    drop_broken_programs(cache, [log, tmp_path / "none"])
    assert [path.name for path in cache.iterdir()] == ["jit_step_two-0c-cache"]
