"""The page on the service names what the messages are."""

import re
from pathlib import Path

import pytest

pytest.importorskip("msgpack")

from qpavoid.service.messages import MAX_CLOUDS, MAX_MESSAGE, MAX_POINTS, REQUESTS, VERSION, Fault, Target, Update

PAGE = (Path(__file__).parent.parent / "docs" / "service.md").read_text(encoding="utf-8")


def test_service_page_has_all_messages_and_errors():
    rows = re.findall(r"^\| (`.*?) \|", PAGE, re.M)
    named = set(re.findall(r"`(\w+)`", " ".join(rows)))
    assert named == set(REQUESTS) | set(Fault.__members__)


def test_service_page_has_all_fields():
    for model in (*REQUESTS.values(), Target, Update):
        for field in model.model_fields:
            assert re.search(rf"`{field}`|\"{field}\"", PAGE), f"{model.__name__}.{field}"


def test_service_page_has_the_limits():
    assert f"`version` ({VERSION})" in PAGE and f"more than {MAX_MESSAGE // 1000 // 64 * 64} kB" in PAGE
    assert f"{MAX_CLOUDS} frames of {MAX_POINTS // 1000} 000 points" in PAGE


def test_service_page_options_exist(cli):
    shown = cli("serve", "--help").stdout
    assert "[s]" in shown
    for option in {"--set", "--solver", "--port", "--host", "--heartbeat", "--motions"}:
        assert option in shown and option in PAGE
