"""Runs what the queue holds: drives the rig, computes results, ticks once a minute.

Nothing of the product imports this package. `inspection` rings it by task name, so a web server needs no motor driver
and a worker can live on another machine. Celery carries the doorbell only; the database rows are the queue.
"""
