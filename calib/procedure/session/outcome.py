"""What a session was judged: the worse of its stages' verdicts, and the mark that a failed one's export carries."""

from __future__ import annotations

import re
from pathlib import Path

from calib import files
from calib.procedure.session.folder import Session

ORDER = ("pass", "marginal", "fail")
FIRST = "verdict fail: "  # how a README.txt of ours begins; another's is left alone
DECLARATION, BOM = b"?>", b"\xef\xbb\xbf"


def verdicts(session: Session) -> dict[str, tuple[str, str]]:
    """Return verdict and reason of each stage."""
    geometry = session.validation.metrics()
    found = {"geometry": (geometry.verdict, geometry.reason)}
    if session.dynamic:
        dynamics = session.identification.unseen.verdict()
        found["dynamics"] = (dynamics.verdict, dynamics.reason)
    return found


def verdict_of(session: Session) -> str:
    """Return the worse of the stages' verdicts."""
    return max((verdict for verdict, _ in verdicts(session).values()), key=ORDER.index)


def mark_failed(session: Session, out: Path) -> list[str]:
    """Write into the exported URDFs' head, and a README.txt beside them, where a verdict is fail; return what to say.

    Without a failed stage an earlier README.txt is taken away.
    """
    failed = [f"{stage}: {reason}" for stage, (verdict, reason) in verdicts(session).items() if verdict == "fail"]
    readme = out / "README.txt"
    if not failed:
        if readme.exists() and readme.read_text(encoding="utf-8", errors="replace").startswith(FIRST):
            readme.unlink()
        return []
    words = f"{FIRST}{'; '.join(failed)}; do not use"
    files.write(readme, f"{words}\nThe files in this folder were exported for inspection only.\n")
    for path in sorted(out.rglob("*.urdf")):
        files.write(path, headed(path.read_bytes(), words))
    return [words]


def headed(content: bytes, words: str) -> bytes:
    """Return XML with a comment at its head, behind the declaration; ASCII, as any 8-bit encoding reads it."""
    if b"\0" in content[:4]:  # UTF-16: README.txt says it
        return content
    comment = f"<!-- {re.sub('-(?=-)', '- ', words)} -->".encode("ascii", "xmlcharrefreplace")
    bom = len(BOM) if content.startswith(BOM) else 0
    if not content[bom:].startswith(b"<?xml"):
        return content[:bom] + comment + b"\n" + content[bom:]
    start = content.index(DECLARATION) + len(DECLARATION)
    return content[:start] + b"\n" + comment + content[start:]
