import asyncio

import pytest

from kpbench.ui.guards import MOST_UPLOAD_BYTES, Guard, is_loopback, refuse_reason

LOCAL, OPEN = "127.0.0.1", "0.0.0.0"


@pytest.mark.parametrize(
    ("host", "headers", "status"),
    [
        (LOCAL, {"host": "127.0.0.1:8000"}, None),
        (LOCAL, {"host": "localhost:8000", "origin": "http://localhost:8000"}, None),
        (LOCAL, {"host": "[::1]:8000"}, None),
        (LOCAL, {"host": "evil.example:8000"}, 421),
        (LOCAL, {"host": "127.0.0.1.evil.example"}, 421),
        (LOCAL, {"host": "192.168.1.7:8000"}, 421),
        (LOCAL, {}, 421),
        (LOCAL, {"host": "["}, 421),
        (LOCAL, {"host": "localhost:8000", "origin": "http://["}, 403),
        (OPEN, {"host": "192.168.1.7:8000"}, None),
        (OPEN, {"host": "evil.example:8000"}, 421),
        (LOCAL, {"host": "localhost:8000", "origin": "http://localhost:8001"}, 403),
        (LOCAL, {"host": "localhost:8000", "origin": "http://evil.example"}, 403),
        (LOCAL, {"host": "localhost:8000", "origin": "null"}, 403),
    ],
)
def test_requests_of_other_names_and_pages_are_refused(host, headers, status):
    refused = refuse_reason(headers, "GET", host)
    assert (refused and refused[0]) == status


def test_an_upload_has_a_length_and_not_too_great_a_one():
    host = {"host": "localhost:1"}
    assert refuse_reason(host, "POST", LOCAL)[0] == 411
    assert refuse_reason({**host, "content-length": str(MOST_UPLOAD_BYTES)}, "POST", LOCAL) is None
    status, line = refuse_reason({**host, "content-length": str(MOST_UPLOAD_BYTES + 2**20)}, "POST", LOCAL)
    assert (status, line) == (413, "257 MiB, expected at most 256 MiB")


def test_loopback_is_this_machine_alone():
    assert [is_loopback(host) for host in ("127.0.0.1", "::1", "localhost", "0.0.0.0", "10.0.0.1", "x.org")] == (
        [True] * 3 + [False] * 3
    )


def answers(scope):
    """The messages that a guard before an application sends."""
    sent = []

    async def application(scope, receive, send):
        await send({"type": "http.response.start", "status": 200, "headers": []})

    async def receive():
        return {"type": "websocket.connect"}

    async def send(message):
        sent.append(message)

    asyncio.run(Guard(application, LOCAL)(scope, receive, send))
    return sent


def test_a_guard_refuses_or_answers_with_a_policy():
    good, bad = [(b"host", b"localhost:1")], [(b"host", b"evil.example")]
    assert answers({"type": "websocket", "headers": bad}) == [{"type": "websocket.close", "code": 1008}]
    assert [message.get("status") for message in answers({"type": "http", "headers": bad})] == [421, None]
    [start] = answers({"type": "http", "headers": good})
    policy = dict(start["headers"])[b"content-security-policy"]
    assert b"default-src 'self'" in policy
    assert b"frame-ancestors 'none'" in policy
