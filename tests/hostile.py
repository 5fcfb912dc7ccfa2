"""What tests of hostile files share: a file is read, or refused by one clear InputError."""

import re

from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from hloc_reduce.utils.cli import InputError

fuzzed = settings(
    max_examples=100, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
HARMFUL = [
    "nan",
    "-inf",
    "1e400",
    "9" * 5000,
    "-1",
    "18446744073709551616",
    "1e308",
    "1e-320",
    "0",
    "NaN",
    "Infinity",
    "null",
    "[]",
    "{}",
    '"',
    "\0",
    "\ufeff",
    "٣",
    "0x10",
    "0" * 9,
    "..",
    "/etc/a.jpg",
    "#",
    "'",
    "&a [*a]",
    "!!python/object/apply:os.abort []",
    "2020-99-99",
    "!!int x",
    "!!float x",
    "!!bool x",
    "!!timestamp x",
    "? {}",
    "\u2028",
]


class Harm:
    """Makes a folder when it is unpickled."""

    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return type(self.path).mkdir, (self.path,)


def refuses_or_reads(read, path):
    """Read a file, which may be refused by an InputError that names it, but in no other way."""
    try:
        return read(path)
    except InputError as error:
        assert path.name in str(error) or str(path.parent) in str(error)
        assert str(error).count("\n") < 2
        return None


def overwrite(path, content):
    """Replace the bytes of a file, several times faster than `write_bytes`."""
    with path.open("r+b") as file:
        file.write(content)
        file.truncate()


def check_text(path, lines, read):
    """Read a text file, first sound, then any text, then with something harmful or wrong in it.

    Args:
        path: the file, which is written.
        lines: of a sound file.
        read: what parses the file.
    """
    content = "\n".join(lines)
    path.write_text(content, encoding="utf-8")
    read(path)
    # where words are, and what is between them
    tokens = [(found.start(), found.end()) for found in re.finditer(r"[\w.-]+|\W", content)]

    def changed(text):
        overwrite(path, text if isinstance(text, bytes) else text.encode(errors="surrogatepass"))
        refuses_or_reads(read, path)

    for start, end in tokens:
        for piece in ["", *HARMFUL, *["[" * 2000] * (start == 0)]:  # which takes long to refuse
            changed(content[:start] + piece + content[end:])
    fuzzed(given(st.binary() | st.text())(changed))()

    @fuzzed
    @given(data=st.data(), piece=st.text(max_size=4))
    def something_wrong(data, piece):
        start, end = data.draw(st.sampled_from(tokens))
        changed(content[:start] + piece + content[data.draw(st.sampled_from([start, end])) :])

    something_wrong()
