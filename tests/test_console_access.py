"""Who may ask the console for what."""

import re
from pathlib import Path

import pytest
from asking import BEARER, HOST, OWN, TOKEN, client
from hypothesis import given
from hypothesis import strategies as st
from starlette.websockets import WebSocketDisconnect

from lumidock.app.console.routes import application
from lumidock.streams.localweb import is_loopback


@pytest.mark.parametrize("path", ["/", "/static/main.js", "/api/about", "/api/settings", "/health.json"])
def test_this_machine_reads_without_a_token(live, path):
    assert client(live).get(path).status_code == 200


@pytest.mark.parametrize("host", ["evil.example", "evil.example:8780", "127.0.0.1.evil.example", "[::1", ""])
def test_a_name_that_anybody_can_point_here_is_refused(live, host):
    answer = client(live).get("/api/about", headers={"Host": host})
    assert answer.status_code in (400, 421)


@pytest.mark.parametrize("host", ["localhost:8780", "127.0.0.1", "[::1]:8780"])
def test_this_machine_is_known_by_its_names(live, host):
    assert client(live).get("/api/about", headers={"Host": host}).status_code == 200


@pytest.mark.parametrize("origin", ["http://evil.example", "null", "http://127.0.0.1:9999", "https://127.0.0.1", ""])
def test_the_page_of_another_site_is_refused(live, origin):
    for method in ("GET", "POST"):
        answer = client(live).request(method, "/api/settings", headers={"Origin": origin, **BEARER})
        assert answer.status_code == 403


def writing(console):
    return [route.path for route in application(console).routes if getattr(route, "methods", None) == {"POST"}]


def test_blueos_is_told_what_answers_here(live):
    found = client(live, "0.0.0.0", "http://localhost:8780").get("/register_service").json()
    assert {"name", "description", "icon", "company", "version", "webpage", "api"} <= found.keys()


def test_nothing_is_written_without_the_token(live):
    page, paths = client(live), writing(live)
    assert len(paths) >= 10
    for path in paths:
        for headers in ({}, {"Authorization": "Bearer wrong"}, {"Authorization": ""}):
            assert page.post(path, json={}, headers=headers).status_code == 401, path


def test_another_address_wants_the_token_for_all_but_the_page(live):
    page = client(live, "192.168.2.2", "http://192.168.2.2:8780")
    assert page.get("/").status_code == 200
    assert page.get("/api/about").status_code == 401
    assert page.get("/api/about", headers=BEARER).status_code == 200
    host = {"Host": "192.168.2.2:8780"}
    with pytest.raises(WebSocketDisconnect), page.websocket_connect("/api/live", headers=host):
        pass
    offered = ["lumidock", f"token.{TOKEN}"]
    with page.websocket_connect("/api/live", subprotocols=offered, headers=host) as socket_:
        assert socket_.accepted_subprotocol == "lumidock"


@pytest.mark.parametrize("headers", [{"Host": "evil.example"}, {"Origin": "http://evil.example"}])
def test_the_live_socket_is_guarded_too(live, headers):
    with pytest.raises(WebSocketDisconnect), client(live).websocket_connect("/api/live", headers=OWN | headers):
        pass
    with client(live).websocket_connect("/api/live", headers=OWN | {"Origin": HOST}):
        pass


def test_a_body_is_small_and_json(live):
    page = client(live)
    assert page.post("/api/check", content=b"x" * 70_000, headers=BEARER).status_code == 413
    assert page.post("/api/preview", content=b"[1", headers=BEARER).status_code == 400
    assert page.post("/api/preview", content=b"[1]", headers=BEARER).json() == {"error": "wanted a JSON object"}


def test_the_policy_lets_nothing_in_from_outside(live):
    answer = client(live).get("/")
    policy = answer.headers["content-security-policy"]
    assert "default-src 'none'" in policy
    assert "unsafe" not in policy
    assert answer.headers["x-content-type-options"] == "nosniff"


STATIC = Path(__file__).parents[1] / "src" / "lumidock" / "app" / "console" / "static"


def test_the_page_names_no_other_host_and_has_nothing_inline():
    for path in STATIC.iterdir():
        text = path.read_text(encoding="utf-8").replace("http://www.w3.org/2000/svg", "")
        assert not re.search(r"(https?|wss?):?//[\w]", text), path.name
        assert len(text.splitlines()) <= 500
    page = (STATIC / "index.html").read_text(encoding="utf-8")
    assert not re.search(r"<style|style=|\son\w+=|<script(?![^>]*src)", page)


@pytest.mark.parametrize("name", ["../routes.py", "..%2froutes.py", "main.py", "nothing.js"])
def test_only_files_of_the_page_are_given(live, name):
    assert client(live).get(f"/static/{name}").status_code == 404


@given(st.text(max_size=60))
def test_any_host_is_loopback_or_not(host):
    assert is_loopback(host) in (True, False)
