"""What every study shares: figures with intervals, live tables, plots and a report that opens offline."""

from experiments.reporting.document import Card, Clip, Clips, Figure, Report, Section
from experiments.reporting.folder import OutputFolder
from experiments.reporting.progress import StudyProgress
from experiments.reporting.provenance import checkpoint_record, package_versions
from experiments.reporting.results import Checkpoint, Results, Row
from experiments.reporting.table import Cell, Table, TableRow

__all__ = [
    "Card",
    "Cell",
    "Checkpoint",
    "Clip",
    "Clips",
    "Figure",
    "OutputFolder",
    "Report",
    "Results",
    "Row",
    "Section",
    "StudyProgress",
    "Table",
    "TableRow",
    "checkpoint_record",
    "package_versions",
]
