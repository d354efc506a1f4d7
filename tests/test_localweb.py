"""Requests that a server of this machine answers, and those of other people's pages that it does not."""

import http.client
import socket

import pytest

from lumidock.streams.healthpage import HealthPage
from lumidock.streams.localweb import is_known_host, is_own_origin

HERE = ["127.0.0.1:8780", "localhost:8780", "[::1]:8780", "LOCALHOST", "127.0.0.1"]
ELSEWHERE = ["evil.example", "evil.example:8780", "localhost.evil.example:8780", "127.0.0.1.evil.example", ""]


@pytest.mark.parametrize("listening", ["127.0.0.1", "::1", "localhost", "0.0.0.0", "192.168.2.1"])
def test_hosts(listening):
    assert all(is_known_host(listening, host) for host in HERE)
    assert not any(is_known_host(listening, host) for host in ELSEWHERE)
    on_the_network = listening in ("0.0.0.0", "192.168.2.1")
    for host in ("192.168.2.1:8780", "10.0.0.5", f"{socket.gethostname()}:8780"):
        assert is_known_host(listening, host) == on_the_network


@pytest.mark.parametrize(
    ("origin", "answered"),
    [
        ("http://127.0.0.1:8780", True),
        ("https://127.0.0.1:8780", True),
        ("http://127.0.0.1:9999", False),
        ("http://localhost:8780", False),
        ("https://evil.example", False),
        (None, True),
        ("null", False),
        ("", False),
    ],
)
def test_origins(origin, answered):
    assert is_own_origin("127.0.0.1:8780", origin) == answered


@pytest.mark.parametrize(
    ("headers", "status"),
    [
        ({}, 200),
        ({"Host": "localhost"}, 200),
        ({"Host": "evil.example"}, 403),
        ({"Origin": "https://evil.example"}, 403),
    ],
)
def test_the_health_page_is_not_for_other_peoples_pages(headers, status):
    page = HealthPage("127.0.0.1", 0, lambda: {"ok": True})
    try:
        client = http.client.HTTPConnection("127.0.0.1", page.port, timeout=5)
        client.request("GET", "/health.json", headers=headers)
        answer = client.getresponse()
        assert answer.status == status
        assert (b'"ok"' in answer.read()) == (status == 200)
        client.close()
    finally:
        page.close()
