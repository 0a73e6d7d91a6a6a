"""The Celery application: `celery -A worker worker --queues rig.<slug>`, `--queues compute`, `celery -A worker beat`.

What the settings below are for was measured (patterns.md 0, D1, D4): with late acknowledgement Redis started a second
copy of a running scan beside the first, and a progress report through the broker killed a scan when Redis restarted.
So hardware tasks are acknowledged before they start and never repeated, and no result backend exists at all.
"""

from __future__ import annotations

import os

import django
from celery import Celery
from django.apps import apps

os.environ.setdefault("DJANGO_SETTINGS_MODULE", "inspection.settings")
if not apps.ready:
    django.setup()

from django.conf import settings

from inspection.services.ring import COMPUTE_QUEUE, broker_options

#: The tick is late at worst by this; a second one waiting behind a busy worker says nothing new.
TICK_EVERY_S = 60.0
#: Dead workers are found this often: with the lease it bounds how long a scan shows "running" though nobody runs it.
SWEEP_EVERY_S = 3.0
MAKE_ROOM_EVERY_S = 6 * 3600.0

app = Celery("worker", broker=settings.REDIS_URL)
app.conf.update(
    imports=["worker.rig", "worker.compute", "worker.tick"],
    broker_transport_options=broker_options(settings.REDIS_URL),
    broker_connection_retry_on_startup=True,
    broker_connection_max_retries=None,
    task_ignore_result=True,
    task_acks_late=False,
    task_default_queue=COMPUTE_QUEUE,
    worker_prefetch_multiplier=1,
    worker_cancel_long_running_tasks_on_connection_loss=False,
    worker_soft_shutdown_timeout=60.0,  # counts where SIGTERM is mapped to SIGQUIT (docker-compose.yml)
    worker_send_task_events=False,
    beat_schedule={
        "tick": {
            "task": "worker.tick",
            "schedule": TICK_EVERY_S,
            "options": {"queue": COMPUTE_QUEUE, "expires": TICK_EVERY_S - 5.0},
        },
        "sweep": {
            "task": "worker.sweep",
            "schedule": SWEEP_EVERY_S,
            "options": {"queue": COMPUTE_QUEUE, "expires": SWEEP_EVERY_S * 3.0},
        },
        "make room": {
            "task": "worker.make_room",
            "schedule": MAKE_ROOM_EVERY_S,
            "options": {"queue": COMPUTE_QUEUE, "expires": MAKE_ROOM_EVERY_S},
        },
    },
)
