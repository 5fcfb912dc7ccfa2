"""Make the links and pictures of README.md absolute, because PyPI shows it without the repository.

python .ci/absolute_links.py https://github.com/OWNER/NAME COMMIT
"""

import re
import sys
from pathlib import Path


def absolute(text: str, repository: str, commit: str) -> str:
    """Return Markdown whose relative links lead to files of a commit in a repository."""
    relative = r"\]\((?!\w+:|#)([^)\s]+)\)"
    text = re.sub(rf"(!\[[^]]*){relative}", rf"\1]({repository}/raw/{commit}/\2)", text)
    return re.sub(relative, rf"]({repository}/blob/{commit}/\1)", text)


if __name__ == "__main__":
    readme = Path("README.md")
    readme.write_text(absolute(readme.read_text(), *sys.argv[1:]))
