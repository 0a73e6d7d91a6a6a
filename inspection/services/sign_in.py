"""Wrong passwords make the next try wait, by name and address, so that a password cannot be found by trying.

Five wrong ones may happen to anybody on a shop-floor keyboard. From then on each makes the next wait twice as long, up
to a quarter of an hour. Counted per name and address together: nobody can lock a colleague out from another screen.
An address that tries many names waits as well. The attempt is counted before the password is looked at, so that many
tries at the same moment count as many. A table of our own instead of a package: it is two queries, and works without
Redis.
"""

from __future__ import annotations

import datetime as dt

from django.db import transaction
from django.db.models import F, Sum
from django.utils import timezone

from inspection.models import SignInFailure, User
from inspection.services.audit import audit
from scanning.errors import BadInput

FREE_TRIES = 5
#: Wrong passwords from one address under all names together before it waits.
FREE_TRIES_PER_ADDRESS = 50
FIRST_WAIT = dt.timedelta(minutes=1)
LONGEST_WAIT = dt.timedelta(minutes=15)
#: Failures older than this are forgotten.
MEMORY = dt.timedelta(hours=1)


class WaitFirst(BadInput):
    """Too many wrong passwords; the sentence says how long to wait."""


def wait_after(count: int, free: int) -> dt.timedelta:
    """How long the next try must wait after ``count`` wrong ones."""
    if count < free:
        return dt.timedelta(0)
    doubled: dt.timedelta = FIRST_WAIT * 2 ** min(count - free, 10)
    return min(doubled, LONGEST_WAIT)


def begin_attempt(name: str, address: str, *, now: dt.datetime | None = None) -> None:
    """Count an attempt to sign in, or raise `WaitFirst` if it comes too soon (it is then not counted)."""
    now = now or timezone.now()
    name, address = name.casefold()[:150], address[:45]
    with transaction.atomic():
        SignInFailure.objects.filter(last_at__lt=now - MEMORY).delete()
        row, _ = SignInFailure.objects.get_or_create(name=name, address=address, defaults={"last_at": now})
        row = SignInFailure.objects.select_for_update().get(pk=row.pk)
        here = SignInFailure.objects.filter(address=address).aggregate(n=Sum("count"))["n"] or 0
        last = SignInFailure.objects.filter(address=address, count__gt=0).order_by("-last_at").first()
        free_at = now
        if wait := wait_after(row.count, FREE_TRIES):
            free_at = row.last_at + wait
        if last is not None and here >= FREE_TRIES_PER_ADDRESS:
            free_at = max(free_at, last.last_at + FIRST_WAIT)
        if free_at > now:
            wait_s = (free_at - now).total_seconds()
            said = f"{wait_s / 60:.0f} min" if wait_s >= 90 else f"{max(wait_s, 1):.0f} s"
            raise WaitFirst(f"Too many wrong passwords from here. Wait {said}, then try again, or ask your admin.")
        SignInFailure.objects.filter(pk=row.pk).update(count=F("count") + 1, last_at=now)


def signed_in(user: User, name: str, address: str) -> None:
    """The password was right: forget the wrong ones before it."""
    name, address = name.casefold()[:150], address[:45]
    with transaction.atomic():
        row = SignInFailure.objects.filter(name=name, address=address).first()
        if row is not None:
            if row.count > FREE_TRIES:
                audit(user, "sign-in.after_failures", user, after={"failures": row.count - 1, "address": address})
            row.delete()
