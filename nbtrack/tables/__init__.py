"""The paper's tables: long DataFrames in; wide DataFrames, styled HTML, LaTeX and CSV out."""

from nbtrack.tables.layout import (
    PAPER_SCENE_LABELS,
    STANDING_STILL,
    beside_published,
    naming_points,
    over_rooms,
    published_table_1,
    published_table_2,
    table_1,
    table_2,
)
from nbtrack.tables.styles import (
    style_table_1,
    style_table_2,
    write_csv,
    write_table_1,
    write_table_3,
    write_tables,
)
