"""Control charts for what should stay the same, never for wear; wear has `inspection.trends.wear`.

The charts themselves are part of measuring, where the check standard needs them without a database.
"""

from scanning.control_charts import Cusum, Ewma, Individuals, cusum, ewma, individuals

__all__ = ["Cusum", "Ewma", "Individuals", "cusum", "ewma", "individuals"]
