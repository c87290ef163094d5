"""What plugins build on changes only with a word in the CHANGELOG."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests import public_surface


def test_the_public_face_is_the_recorded_one() -> None:
    changed = public_surface.differences(public_surface.recorded()[1], public_surface.surface())
    assert not changed, (
        f"the public face of plugins changed: say so in CHANGELOG.md under "
        f'"{public_surface.SECTION}", then run `{public_surface.COMMAND}`:\n' + "\n".join(changed)
    )


def test_a_change_without_a_changelog_entry_is_not_recorded(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    record, changelog = tmp_path / "docs" / "public-api.txt", tmp_path / "CHANGELOG.md"
    record.parent.mkdir()
    changelog.write_text(f"{public_surface.SECTION}\n\n- first\n\n## 0.0.1\n")
    monkeypatch.setattr(public_surface, "RECORD", record)
    monkeypatch.setattr(public_surface, "CHANGELOG", changelog)
    monkeypatch.setattr(public_surface, "ROOT", tmp_path)
    monkeypatch.setattr(public_surface, "surface", lambda: ["a(x)"])
    assert public_surface.main() == 0
    monkeypatch.setattr(public_surface, "surface", lambda: ["a(x, y)"])
    assert public_surface.main() == 1
    assert "- a(x)\n+ a(x, y)" in capsys.readouterr().out
    assert public_surface.recorded()[1] == ["a(x)"]
    changelog.write_text(f"{public_surface.SECTION}\n\n- first\n- `a` takes y\n\n## 0.0.1\n")
    assert public_surface.main() == 0
    assert public_surface.recorded()[1] == ["a(x, y)"]
