"""`manage.py demo`: fill an installation with the demo plant: a simulated rig, knives with regions, people, history."""

from __future__ import annotations

from typing import Any

from django.core.management.base import BaseCommand, CommandParser

from inspection.demo.plant import make_demo_plant, make_histories
from inspection.models import Tool


class Command(BaseCommand):
    help = "Make the demo plant. Does nothing to what is already there."

    def add_arguments(self, parser: CommandParser) -> None:
        parser.add_argument("--histories", action="store_true", help="Only add the knives' earlier visits.")
        parser.add_argument("--if-empty", action="store_true", help="Only when there is no tool yet.")

    def handle(self, *args: Any, **options: Any) -> None:
        if options["if_empty"] and Tool.objects.exists():
            self.stdout.write("There are tools already; nothing added.")
            return
        if options["histories"]:
            make_histories(self.stdout.write)
            return
        plant = make_demo_plant(self.stdout.write)
        make_histories(self.stdout.write)
        for name, (role, password) in plant.passwords.items():
            self.stdout.write(f"{name:<8} {role:<9} {password}")
