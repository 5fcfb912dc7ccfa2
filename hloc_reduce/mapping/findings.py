"""What may be wrong with a map: one list, from the mapper to map.json and to the user."""

from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Literal, get_args

from .. import logger
from ..utils import cli
from ..utils.cli import InputError

Verdict = Literal["drop", "refuse", "warn"]
PHOTOS_NAMED = 10  # photos that a message names
ACCEPT = "To use the map as it is, run again with --accept_partial."


@dataclass(frozen=True)
class Finding:
    """One thing that may be wrong with a map.

    Args:
        kind: name of the check, a key of `checks.CHECKS`.
        text: one or two sentences for the user: what is wrong and what to do. `{names}` stands for
            the photos.
        names: the photos that it concerns, the worst first; empty if it concerns the whole map.
        values: what was measured, by the photo or by what the number is.
        verdict: "drop" if the photos do not belong in the map; "refuse" if the map is not to be
            used unless the user accepts it; else "warn".
        doubt: why poses in the map may be wrong, in a few words; empty if they are not affected.
    """

    kind: str
    text: str
    names: tuple[str, ...] = ()
    values: Mapping[str, float] = field(default_factory=dict)
    verdict: Verdict = "warn"
    doubt: str = ""

    @property
    def message(self) -> str:
        """The text with the names of the photos."""
        return self.text.replace("{names}", cli.some(self.names, PHOTOS_NAMED))

    def to_json(self) -> dict[str, Any]:
        """Return the finding as JSON values."""
        return {**vars(self), "names": list(self.names), "values": dict(self.values)}

    @classmethod
    def from_json(cls, content: Mapping[str, Any]) -> "Finding":
        """Return the finding in JSON values.

        Raises:
            KeyError, TypeError or ValueError: if they are wrong.
        """
        verdict = content["verdict"]
        if verdict not in get_args(Verdict):
            raise ValueError(f"{verdict!r} is no verdict")
        return cls(
            kind=str(content["kind"]),
            text=str(content["text"]),
            names=tuple(str(name) for name in content["names"]),
            values={str(name): float(value) for name, value in dict(content["values"]).items()},
            verdict=verdict,
            doubt=str(content["doubt"]),
        )


def names_in(findings: Iterable[Finding], *kinds: str) -> set[str]:
    """Return the photos that findings of some kinds concern, by default those of all."""
    return {name for one in findings if not kinds or one.kind in kinds for name in one.names}


def without(findings: Iterable[Finding], names: Collection[str]) -> list[Finding]:
    """Return what findings say of other photos than those in `names`."""
    found = []
    for one in findings:
        left = tuple(name for name in one.names if name not in names)
        if left or not one.names:
            values = {key: value for key, value in one.values.items() if key not in names}
            found.append(replace(one, names=left, values=values))
    return found


def merged(findings: Iterable[Finding]) -> list[Finding]:
    """Return findings, one for those that say the same of different photos."""
    found: dict[tuple[str, str], Finding] = {}
    for one in findings:
        if (before := found.get((one.kind, one.text))) is not None:
            names = tuple(dict.fromkeys(before.names + one.names))
            one = replace(before, names=names, values={**before.values, **one.values})
        found[one.kind, one.text] = one
    return [*found.values()]


def staying(findings: Iterable[Finding]) -> list[Finding]:
    """Return findings of photos that stay in a map, which then only warn that these be dropped."""
    return [replace(one, verdict="warn") if one.verdict == "drop" else one for one in findings]


def warn(findings: Iterable[Finding]) -> None:
    """Log the messages of findings as warnings."""
    for one in findings:
        logger.warning(one.message)


def check_accepted(findings: Collection[Finding], accept_partial: bool) -> None:
    """Refuse a map by findings.

    Raises:
        InputError: if the verdict of any is "refuse", unless `accept_partial`. The others, which
            may be why, are logged as warnings before.
    """
    refused = [one.message for one in findings if one.verdict == "refuse"]
    if refused and not accept_partial:
        warn(one for one in findings if one.verdict != "refuse")
        raise InputError(" ".join([*refused, ACCEPT]))
