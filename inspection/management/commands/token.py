"""`manage.py token`: make, list and withdraw keys for other programs."""

from __future__ import annotations

from argparse import ArgumentParser
from typing import Any

from django.core.management.base import BaseCommand, CommandError

from inspection.api.tokens import issue_token, revoke_token
from inspection.models import ApiToken, User
from scanning.errors import BadInput


class Command(BaseCommand):
    help = "Make (new), list or withdraw (revoke) API tokens."

    def add_arguments(self, parser: ArgumentParser) -> None:
        actions = parser.add_subparsers(dest="action", required=True)
        new = actions.add_parser("new", help="make a token and print it once")
        new.add_argument("owner", help="user name the token acts for")
        new.add_argument("name", help="which program will use it")
        new.add_argument("--scope", choices=ApiToken.Scope.values, default=ApiToken.Scope.READ)
        actions.add_parser("list", help="show all tokens, without their secrets")
        revoke = actions.add_parser("revoke", help="make a token useless")
        revoke.add_argument("start", help="the token's first characters, as `list` shows them")

    def handle(self, *args: Any, **options: Any) -> None:
        match options["action"]:
            case "new":
                owner = User.objects.filter(username=options["owner"]).first()
                if owner is None:
                    raise CommandError(f"There is no user {options['owner']!r}.")
                try:
                    _, secret = issue_token(owner=owner, name=options["name"], scope=options["scope"], by=owner)
                except BadInput as fault:
                    raise CommandError(str(fault)) from fault
                self.stdout.write(secret)
                self.stderr.write("Keep it now: it is not shown again.")
            case "list":
                for token in ApiToken.objects.select_related("owner"):
                    ended = f"revoked {token.revoked_at:%Y-%m-%d}" if token.revoked_at else "live"
                    used = f"{token.last_used_at:%Y-%m-%d %H:%M}" if token.last_used_at else "never"
                    whose = f"{token.start}  {token.scope:5}  {token.owner}  {token.name}"
                    self.stdout.write(f"{whose}  used {used}  {ended}")
            case "revoke":
                found = list(ApiToken.objects.select_related("owner").filter(start=options["start"], revoked_at=None))
                if len(found) != 1:
                    raise CommandError(f"{len(found)} live tokens start with {options['start']!r}; see `token list`.")
                revoke_token(found[0], by=found[0].owner)
                self.stdout.write(f"{found[0]} is revoked.")
