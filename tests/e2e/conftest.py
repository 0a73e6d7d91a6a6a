"""Playwright's synchronous interface runs an event loop, which Django would otherwise take for asynchronous code."""

from __future__ import annotations

import os

os.environ.setdefault("DJANGO_ALLOW_ASYNC_UNSAFE", "true")
