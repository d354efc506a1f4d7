import pytest
from hypothesis import given
from hypothesis import strategies as st

from lumidock.errors import InputError
from lumidock.streams.address import address_of

SECRET = "s3cr3t"


@pytest.mark.parametrize(
    ("text", "parts"),
    [
        ("rtsp://cam/front", ("", "", "cam", None, "/front")),
        ("rtsp://10.0.0.7:554/a/b?c=d", ("", "", "10.0.0.7", 554, "/a/b?c=d")),
        ("rtsp://u:p@cam:8554/front", ("u", "p", "cam", 8554, "/front")),
        ("rtsp://u:p#s@cam/front", ("u", "p#s", "cam", None, "/front")),
        ("rtsp://u:p@ss@cam/front", ("u", "p@ss", "cam", None, "/front")),
        ("rtsp://u:p/s?s@cam/front", ("u", "p/s?s", "cam", None, "/front")),
        ("rtsp://u:p%40s@cam/front", ("u", "p@s", "cam", None, "/front")),
        ("rtsp://cam/front@2x", ("", "", "cam", None, "/front@2x")),
        ("rtsp://u:p@[fe80::1]:554/x", ("u", "p", "[fe80::1]", 554, "/x")),
        ("rtp://127.0.0.1:5600", ("", "", "127.0.0.1", 5600, "")),
    ],
)
def test_the_parts_of_an_address(text, parts):
    found = address_of(text)
    assert (found.user, found.password, found.host, found.port, found.path) == parts
    assert address_of(found.url) == found


@pytest.mark.parametrize(
    "text",
    [
        f"rtsp://admin:{SECRET}@10.0.0.7/live",
        f"rtsp://10.0.0.7/user=admin&password={SECRET}&channel=1",
        f"rtsp://10.0.0.7:554/user=admin_password={SECRET}_channel=1_stream=0.sdp",
        f"rtsp://10.0.0.7/live?pwd={SECRET}",
        f"rtsp://10.0.0.7/live?token={SECRET}",
        f"rtsp://a:x@{SECRET}@10.0.0.7/live",
    ],
)
def test_no_secret_is_shown(text):
    assert SECRET not in address_of(text).shown
    assert "10.0.0.7" in address_of(text).shown


@given(st.text(st.characters(exclude_characters="\0"), min_size=1, max_size=20), st.text("@/#?:%ab", min_size=1))
def test_any_password_is_carried_over(user, password):
    if ":" in user or "%" in user + password or "/" in user or "@" in user or "?" in user or "#" in user:
        return
    if password.endswith(("a", "b")) and "@" in password:
        return  # what follows the @ could be the host
    found = address_of(f"rtsp://{user}:{password}@host.example/path")
    assert (found.user, found.password, found.host) == (user, password, "host.example")


@given(st.text(max_size=40))
def test_anything_is_an_address_or_one_line_without_it(text):
    problem = ""
    try:
        address_of(f"rtsp://{text}")
    except InputError as error:
        problem = str(error)
    assert problem in ("", "rtsp: no host in the address; wanted rtsp://HOST/PATH, rtp://HOST:PORT")
