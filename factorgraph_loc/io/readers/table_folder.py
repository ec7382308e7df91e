"""The folder of the foreign tables of a log, with notes of what is left out of them."""

from collections.abc import Collection, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from factorgraph_loc.files.column_mapping import ColumnMapping, Mapped, read_mapped
from factorgraph_loc.files.models import inside
from factorgraph_loc.text import listed


@dataclass
class _Choice:
    """The rows that mappings choose of a file: the ``count`` of all rows, the number of ``others``, the ``names`` of the columns by
    which they are chosen, and the line numbers of those that are ``read``."""

    count: int
    others: int
    names: dict[str, None] = field(default_factory=dict)
    read: set[int] = field(default_factory=set)


class TableFolder:
    """The folder of a log's tables. ``warnings``: lines about their content.

    Several mappings may read the same file; a column or a row that one of them reads is read.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.warnings: list[str] = []
        self._left_out: dict[Path, tuple[str, ...]] = {}  # columns by file
        self._choices: dict[Path, _Choice] = {}

    def file(self, name: str) -> Path:
        """The path of a file in the folder; InputError if it lies elsewhere."""
        return inside(self.path, name, self.path)

    def read(self, mapping: ColumnMapping, shapes: Sequence[Collection[str]]) -> Mapped:
        """Read the table of a mapping as :func:`read_mapped`, and note what is left out of it."""
        return self.noted(read_mapped(self.file(mapping.file), mapping, shapes))

    def noted(self, mapped: Mapped) -> Mapped:
        """Note what ``mapped`` leaves out of its file, and return it."""
        path, rows = mapped.path, mapped.rows.tolist()
        if mapped.passed:
            self.warnings.append(f"{path}: {mapped.passed} objects that lack mapped columns are skipped")
        if mapped.unwanted:
            rows_chosen = mapped.unwanted + len(rows)
            choice = self._choices.setdefault(path, _Choice(mapped.passed + rows_chosen, rows_chosen))
            choice.names |= dict.fromkeys(mapped.mapping.where)
            choice.others -= sum(row not in choice.read for row in rows)
            choice.read |= set(rows)
        left_out = dict.fromkeys(mapped.left_out)
        before = self._left_out.get(path, mapped.left_out)
        self._left_out[path] = tuple(name for name in before if name in left_out)
        return mapped

    def left_out(self) -> list[str]:
        """A line for each choice of rows, and one for all files with the same columns that are not read."""
        lines = [
            f"{path.name}: {choice.others} of {choice.count} rows have another {listed(choice.names)} than where says"
            for path, choice in self._choices.items()
            if choice.others > 0
        ]
        for names in dict.fromkeys(names for names in self._left_out.values() if names):
            first, *others = [path.name for path, columns in self._left_out.items() if columns == names]
            more = f" and {len(others)} more files" if others else ""
            lines.append(f"{first}{more}: columns that are not read: {listed(names)}")
        return lines
