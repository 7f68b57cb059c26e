"""Links of Markdown pages to files of the repository that lie outside of docs/ become the files' paths."""

import re
from pathlib import Path

LINK = re.compile(r"(?<!!)\[([^\]]+)\]\((?P<path>(?:\.\./)+[^)#\s]+)\)")


def name_files(app, docname, source):
    """Writes ``[text](../../benchmarks/x.md)`` as text, followed by the path: a site has no page for it."""
    page, docs = Path(app.env.doc2path(docname)), Path(app.srcdir).resolve()

    def written_out(match):
        target = (page.parent / match["path"]).resolve()
        if target.is_relative_to(docs):
            return match[0]
        return f"{match[1]}: `{target.relative_to(docs.parent)}`"

    if page.suffix == ".md":
        source[0] = LINK.sub(written_out, source[0])


def setup(app):
    """Registers the extension."""
    app.connect("source-read", name_files)
    return {"parallel_read_safe": True}
