"""What goes wrong ends in a sentence: bad workflow files, bad scans, methods that misbehave."""

from __future__ import annotations

from pathlib import Path

import pytest
from click.testing import CliRunner

from orthoflow.cli.program import program
from tests.road.conftest import Shell


def test_a_bad_scan_ends_in_one_sentence_with_exit_code_two(
    shell: Shell, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "corrupt.laz").write_bytes(b"LASF" + bytes(range(256)) * 8)
    monkeypatch.chdir(tmp_path)
    # In this process; the steps of the next test are processes.
    words = ["run", "direct.yaml", "--input", "scan=corrupt.laz", "-o", "run"]
    how = ["--executor", "inline", "--store", str(shell.store)]
    ended = CliRunner().invoke(program, [*words, *how])
    assert ended.exit_code == 2
    assert "Traceback" not in ended.output
    assert "corrupt.laz" in ended.output


def test_a_truncated_laz_is_named(shell: Shell, tmp_path: Path, shared_data: Path) -> None:
    whole = (shared_data / "lion-takanawa" / "lion_takanawa_1mm.laz").read_bytes()
    (tmp_path / "half.laz").write_bytes(whole[: len(whole) // 2])
    ended = shell("run", "direct.yaml", "--input", "scan=half.laz", "-o", "run")
    assert ended.code == 2
    assert "Traceback" not in ended.said
    assert "half.laz" in ended.said
