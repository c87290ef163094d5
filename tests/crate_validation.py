"""Holds an RO-Crate to its profile with the official validator, without asking the network.

    python tests/crate_validation.py CRATE PROFILE

Prints the issues as JSON; only what the profile says must be.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))


def _main(crate: Path, profile: str) -> None:
    from rocrate_validator import services
    from rocrate_validator.utils.http import HttpRequester

    from tests.crate_contexts import context_of

    content = json.loads((crate / "ro-crate-metadata.json").read_text())

    class Response:
        status_code = 200
        text = json.dumps(context_of(content))

        @property
        def headers(self) -> dict[str, str]:
            return {"Content-Type": "application/ld+json"}

        def json(self) -> object:
            return json.loads(self.text)

    HttpRequester.get = lambda *_, **__: Response()
    settings = services.ValidationSettings(
        rocrate_uri=str(crate),
        profile_identifier=profile,
        requirement_severity="REQUIRED",
        no_cache=True,
        skip_availability_check=True,
    )
    issues = services.validate(settings).get_issues()
    sys.stdout.write(json.dumps([(issue.check.identifier, issue.message) for issue in issues]))
    sys.stdout.write("\n")


if __name__ == "__main__":
    _main(Path(sys.argv[1]), sys.argv[2])
