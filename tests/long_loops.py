"""Whether the long loops run: more of the same, or what needs the machine for itself."""

import os

# `.ci/run --long` sets it.
IS_LONG = os.environ.get("ORTHOFLOW_LONG_TESTS") == "1"
