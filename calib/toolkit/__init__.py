"""The toolkit's parts for applications, by subject: what `import calib` offers beyond its verbs.

An application imports from here instead of from inner modules, so that those can change. A module is loaded when an
application asks for it: commands import inside their functions, and `calib --help` loads none. What commands need to
declare their options is here itself.
"""

from calib.procedure.answers import CertificateSection

__all__ = ["CertificateSection"]
