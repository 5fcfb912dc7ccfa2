"""Photos that are copies of others: two names for one viewpoint."""

from collections import defaultdict

from ...utils.files import file_sha256
from ..findings import Finding
from .inputs import Inputs


def find(inputs: Inputs) -> list[Finding]:
    """Find the photos whose files have the content of another one, which comes before by name."""
    if inputs.image_dir is None:
        return []
    of_size = defaultdict(list)  # as few photos have the same size, few are read
    for name in inputs.names:
        if (path := inputs.image_dir / name).is_file():
            of_size[path.stat().st_size].append(name)
    copies = []
    for names in of_size.values():
        known = set[str]()
        for name in names if len(names) > 1 else ():
            digest = file_sha256(inputs.image_dir / name)
            if digest in known:
                copies.append(name)
            known.add(digest)
    if not copies:
        return []
    text = (
        "These photos are copies of others: {names}. Points that only a photo and its copy show "
        "look as if two viewpoints confirmed them: build the map without the copies."
    )
    return [Finding("duplicates", text, tuple(sorted(copies)))]
