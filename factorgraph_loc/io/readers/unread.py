"""What mappings do not read of a log's files."""

from pathlib import Path

from factorgraph_loc.files.column_mapping import Mapped
from factorgraph_loc.text import listed


class Unread:
    """Columns by file, and rows. Several mappings may read the same file; a column that one of them reads is read."""

    def __init__(self) -> None:
        self._columns: dict[Path, tuple[str, ...]] = {}
        self._rows: list[str] = []

    def note(self, mapped: Mapped) -> None:
        """Note what a mapping leaves out of its file."""
        if mapped.unwanted:
            names = listed(mapped.mapping.where)
            count = mapped.unwanted + mapped.passed + len(mapped.rows)
            self._rows.append(
                f"{mapped.path.name}: {mapped.unwanted} of {count} rows have another {names} than where says"
            )
        before = self._columns.get(mapped.path, mapped.left_out)
        self._columns[mapped.path] = tuple(name for name in before if name in mapped.left_out)

    def warnings(self) -> list[str]:
        """A line for each choice of rows, and one for all files with the same columns."""
        files: dict[tuple[str, ...], list[Path]] = {}
        for path, names in self._columns.items():
            files.setdefault(names, []).append(path)
        return self._rows + [
            f"{paths[0].name}{f' and {len(paths) - 1} more files' if paths[1:] else ''}: columns that are not read: {listed(names)}"
            for names, paths in files.items()
            if names
        ]
