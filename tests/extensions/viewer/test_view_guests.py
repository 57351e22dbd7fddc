"""Connections to the page: only the page itself may connect, no other page that a browser shows."""

import socket
import urllib.error
import urllib.request

import pytest
import viser
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect

from finssim.extensions.viewer.app import View
from finssim.extensions.viewer.sources import RecordSource


@pytest.fixture(scope="module")
def port(trial):
    """Port of a served page."""
    view = View(RecordSource(trial.record), port=8260, playing=False)
    yield view.server.get_port()
    view.close()


def opened(port, host, origin):
    """Return the WebSocket's first message or the status of its refusal; the connection goes to this machine."""
    options = {
        "subprotocols": [f"viser-v{viser.__version__}"],
        "additional_headers": {} if origin is None else {"Origin": origin},
        "sock": socket.create_connection(("127.0.0.1", port)),
    }
    try:
        with connect(f"ws://{host}", **options, proxy=None, max_size=None) as page:
            return page.recv(timeout=30.0)
    except InvalidStatus as refusal:
        return refusal.response.status_code


@pytest.mark.slow
def test_only_the_served_page_may_connect(port):
    """The page's WebSocket gets the scene; one of another site, of a rebound name or without an origin gets
    403."""
    own = f"localhost:{port}"
    assert isinstance(opened(port, own, f"http://{own}"), bytes)
    assert isinstance(opened(port, f"127.0.0.1:{port}", f"http://127.0.0.1:{port}"), bytes)
    for host, origin in (
        (own, "http://evil.example"),
        (own, f"https://{own}"),
        (own, "null"),
        (own, None),
        (own, f"http://localhost:{port}1"),
        (f"evil.example:{port}", f"http://evil.example:{port}"),
        (f"localhost.evil.example:{port}", f"http://localhost.evil.example:{port}"),
    ):
        assert opened(port, host, origin) == 403, (host, origin)


@pytest.mark.slow
def test_the_page_is_served_under_names_of_this_machine_alone(port):
    """A request under another name that resolves to this machine gets no page."""
    for host, status in (
        (f"localhost:{port}", 200),
        (f"127.0.0.1:{port}", 200),
        (f"evil.example:{port}", 403),
    ):
        request = urllib.request.Request(f"http://127.0.0.1:{port}/", headers={"Host": host})
        try:
            with urllib.request.urlopen(request, timeout=30.0) as page:
                found = page.status
        except urllib.error.HTTPError as refusal:
            found = refusal.code
        assert found == status


@pytest.mark.slow
def test_the_page_has_its_own_title_and_icon(port):
    """The title and icon of viser are replaced."""
    with urllib.request.urlopen(f"http://127.0.0.1:{port}/", timeout=30.0) as answer:
        head = answer.read(4000).decode()
    assert "<title>FinsSim view</title>" in head and "fill='%230072B2'" in head
    assert "Viser</title>" not in head and "f9e20b" not in head
