"""The one router of version 1: an address that is read by one file and written by another must be one address."""

from __future__ import annotations

from ninja import Router

router = Router()
