"""The viewer's server answers its own page, from this machine, to who knows the token."""

from __future__ import annotations

import pytest

from gmijax.config.view import PageConfig
from gmijax.errors import ConfigError
from gmijax.viewer.guard import Guard, is_loopback

HERE = "127.0.0.1:8080"
GUARD = Guard("127.0.0.1", token="secret")
PUBLIC = Guard("0.0.0.0", ("https://hub.example.org",), token="secret")


def refusal(
    guard: Guard, host: str = HERE, origin: str | None = None, path: str = "/secret/"
) -> str | None:
    return guard.refusal(path, [host], [] if origin is None else [origin])


@pytest.mark.parametrize("host", [HERE, "localhost:9000", "LOCALHOST", "[::1]:8080", "127.0.0.2"])
def test_this_machine_may_ask(host: str) -> None:
    assert refusal(GUARD, host) is None
    assert refusal(GUARD, host, f"http://{host}") is None


@pytest.mark.parametrize(
    "host",
    [
        *("evil.example", "evil.example:8080", "localhost.evil.example", "", "a b", "10.0.0.1"),
        *("127.0.0.1@evil.example", "evil.example#127.0.0.1", "127.0.0.1:8080:1", "127.0.0.1:x"),
    ],
)
def test_another_host_may_not(host: str) -> None:
    assert (refusal(GUARD, host) or "").startswith("unknown host")


def test_one_host_is_needed() -> None:
    assert (GUARD.refusal("/secret/", [], []) or "").startswith("unknown host")
    assert (GUARD.refusal("/secret/", [HERE, HERE], []) or "").startswith("unknown host")


@pytest.mark.parametrize(
    "origin", ["http://evil.example", "http://127.0.0.1:8081", "http://localhost:8080", "null", ""]
)
def test_the_page_of_somebody_else_may_not(origin: str) -> None:
    assert (refusal(GUARD, HERE, origin) or "").startswith("unknown origin")


@pytest.mark.parametrize("path", ["/", "", "/secre/", "/secret2/", "/x/secret", "/?token=secret"])
def test_the_token_is_needed(path: str) -> None:
    assert "token" in str(refusal(GUARD, path=path))


@pytest.mark.parametrize("path", ["/secret", "/secret/", "/secret?a=b", "/secret/x"])
def test_the_token_is_the_first_part_of_the_path(path: str) -> None:
    assert refusal(GUARD, path=path) is None


def test_two_servers_have_two_tokens() -> None:
    assert Guard("127.0.0.1").token != Guard("127.0.0.1").token
    assert len(Guard("127.0.0.1").token) >= 32


def test_beyond_loopback_addresses_pass_and_names_do_not() -> None:
    assert refusal(PUBLIC, "10.0.0.1:8080", "http://10.0.0.1:8080") is None
    assert (refusal(PUBLIC, "evil.example") or "").startswith("unknown host")
    assert "token" in str(refusal(PUBLIC, "10.0.0.1", path="/"))


def test_an_allowed_origin_passes_under_its_own_host_and_ours() -> None:
    allowed = "https://hub.example.org"
    assert refusal(PUBLIC, "hub.example.org", allowed) is None
    assert refusal(PUBLIC, HERE, allowed) is None
    assert (refusal(PUBLIC, HERE, "https://hub.example.org.evil.example") or "").startswith(
        "unknown origin"
    )


@pytest.mark.parametrize("origin", ["hub.example.org", "https://hub/x", "ftp://hub", "*", ""])
def test_what_is_no_origin_is_refused(origin: str) -> None:
    with pytest.raises(ConfigError, match="is no origin"):
        PageConfig(host="127.0.0.1", port=0, allow_origin=(origin,))


def test_what_loopback_is() -> None:
    assert all(map(is_loopback, ("localhost", "127.0.0.1", "::1", "[::1]")))
    assert not any(map(is_loopback, ("0.0.0.0", "10.0.0.1", "example.org", "", "127.0.0.1.evil")))
