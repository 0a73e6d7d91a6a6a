"""The product's settings, with a home of its own that is thrown away.

A test run must never find, or leave, anything in an installation's folders.
"""

from __future__ import annotations

import atexit
import os
import shutil
import tempfile

_home = tempfile.mkdtemp(prefix="edgewatch-test-")
atexit.register(shutil.rmtree, _home, ignore_errors=True)
os.environ["EDGEWATCH_HOME"] = _home
os.environ.pop("DATABASE_URL", None) if not os.environ.get("TEST_DATABASE_URL") else os.environ.update(
    DATABASE_URL=os.environ["TEST_DATABASE_URL"]
)
# A socket nobody listens on: a test that needs a broker starts its own, every other one proves that none is needed.
os.environ["REDIS_URL"] = f"redis+socket://{_home}/no-broker.sock"

from inspection.settings import *  # noqa: E402, F403
from inspection.settings import DATABASES, HOME, STORAGES  # noqa: E402

PASSWORD_HASHERS = ["django.contrib.auth.hashers.MD5PasswordHasher"]
STORAGES = {**STORAGES, "staticfiles": {"BACKEND": "django.contrib.staticfiles.storage.StaticFilesStorage"}}
if DATABASES["default"]["ENGINE"].endswith("sqlite3"):
    # A file, not memory: threads and processes must meet the same locks as in production.
    DATABASES["default"]["TEST"] = {"NAME": str(HOME / "test.sqlite3")}
