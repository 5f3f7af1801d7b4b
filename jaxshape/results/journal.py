"""Rows of a long run, written as they come: a killed run resumes after its last row. [host]"""

import json
from collections.abc import Mapping, Sequence
from glob import escape
from pathlib import Path
from typing import Any, NamedTuple

from jaxshape import reading
from jaxshape.files import write_text


class Journal:
    """The rows of one results file, by name; rows made under other settings are not its own.

    Attributes:
        path: The file.
        settings: Settings under which the rows were made, as JSON holds them.
        rows: Rows by name, in the order in which they came.
        seconds: Time that all rows took, over all runs.
    """

    def __init__(self, path: Path, settings: dict[str, Any]):
        self.path = path
        self.settings: dict[str, Any] = json.loads(json.dumps(settings))  # tuples become lists
        self.rows: dict[str, Any] = {}
        self.seconds = 0.0
        if path.is_file():
            earlier = _read(path)
            if earlier["settings"] == self.settings:
                self.rows, self.seconds = earlier["rows"], earlier["seconds"]

    def add(self, rows: dict[str, Any], seconds: float) -> None:
        """Write some rows and the seconds they took to the file, with all before them."""
        self.rows |= rows
        self.seconds += seconds
        self.write({})

    def forget(self, contents: Mapping[str, str]) -> None:
        """Leave out rows that were made from other content, such as files that have changed.

        Args:
            contents: Digests by the names of rows; other rows stay.
        """
        stale = {
            name
            for name, row in self.rows.items()
            if name in contents and row.get("content", "") != contents[name]
        }
        if stale:
            self.rows = {name: row for name, row in self.rows.items() if name not in stale}
            self.write({})

    def write(self, findings: dict[str, Any]) -> None:
        """Write the file again, with the findings before the rows."""
        about = {"settings": self.settings, "seconds": round(self.seconds, 1)}
        content = json.dumps(about | findings, indent=1)[:-2]
        rows = ",\n".join(f"  {json.dumps(k)}: {json.dumps(v)}" for k, v in self.rows.items())
        write_text(self.path, f'{content},\n "rows": {{\n{rows}\n }}\n}}\n')

    def remove(self) -> None:
        """Remove the file, where the findings are stored elsewhere."""
        self.path.unlink(missing_ok=True)


class Share(NamedTuple):
    """The share of one of several processes in a list: every n-th entry.

    Attributes:
        index: Number of the process, from 0.
        count: Number of processes, 1 or more.
    """

    index: int = 0
    count: int = 1

    def of(self, items: Sequence[Any]) -> list[Any]:
        """The entries that belong to this process.

        Args:
            items: The list, the same for all processes.
        """
        return list(items[self.index :: self.count])

    def journal(self, output: Path, settings: dict[str, Any]) -> Journal:
        """The journal of this process, beside a results file until that file is written.

        Args:
            output: The results file.
            settings: Settings under which its rows are made.
        """
        number = f".{self.index}-of-{self.count}" if self.count > 1 else ""
        return Journal(output.with_name(f"{output.name}.partial{number}"), settings)


def journals_of(output: Path, settings: dict[str, Any]) -> list[Journal]:
    """The journals of all processes beside a results file, however many there were.

    Args:
        output: The results file.
        settings: Settings under which the rows were made; journals of others have no rows.
    """
    paths = output.parent.glob(f"{escape(output.name)}.partial*")
    return [Journal(path, settings) for path in sorted(paths)]


def _read(path: Path) -> dict[str, Any]:
    """The content of a journal; `ValueError` if the file is no journal."""
    try:
        content = reading.read_json_object(path)
        kinds = {"settings": dict, "rows": dict, "seconds": (int, float)}
        if wrong := reading.wrong_kinds(content, kinds):
            raise ValueError(f"its {wrong[0]} are damaged")
        if not all(isinstance(row, dict) for row in content["rows"].values()):
            raise ValueError("one of its rows is damaged")
    except (OSError, ValueError, KeyError) as problem:
        raise ValueError(
            f"{str(path)!r} cannot be resumed ({problem}); remove it to start over."
        ) from problem
    return content
