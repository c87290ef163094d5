"""What goes wrong ends in a sentence: bad workflow files, bad scans, methods that misbehave."""

from __future__ import annotations

from pathlib import Path

import pytest
from click.testing import CliRunner

from orthoflow.cli.program import program
from tests.road.conftest import Shell


def no_traceback(said: str) -> bool:
    return "Traceback" not in said and "site-packages" not in said


BAD_SCANS: dict[str, bytes] = {
    "corrupt.laz": b"LASF" + bytes(range(256)) * 8,
    "empty.las": b"",
    "photo.jpg": b"\xff\xd8\xff\xe0 not a scan",
}


@pytest.mark.parametrize("name", BAD_SCANS, ids=str)
def test_a_bad_scan_ends_in_one_sentence_with_exit_code_two(
    shell: Shell, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    (tmp_path / name).write_bytes(BAD_SCANS[name])
    monkeypatch.chdir(tmp_path)
    # In this process, whose steps come from one server; the next tests start one of their own.
    words = ["run", "direct.yaml", "--input", f"scan={name}", "-o", "run", "--store"]
    ended = CliRunner().invoke(program, [*words, str(shell.store)])
    assert ended.exit_code == 2
    assert no_traceback(ended.output)
    assert name in ended.output


def test_a_truncated_laz_is_named(shell: Shell, tmp_path: Path, shared_data: Path) -> None:
    whole = (shared_data / "lion-takanawa" / "lion_takanawa_1mm.laz").read_bytes()
    (tmp_path / "half.laz").write_bytes(whole[: len(whole) // 2])
    ended = shell("run", "direct.yaml", "--input", "scan=half.laz", "-o", "run")
    assert ended.code == 2
    assert no_traceback(ended.said)
    assert "half.laz" in ended.said
