"""The toolkit's functions and classes for applications, by subject, in addition to the commands of `import calib`.

Applications import from this package instead of from inner modules, so that inner modules can change. A module is
loaded only when an application uses it: commands import inside their functions, and `calib --help` loads none. This
file contains what commands need for the declaration of their options.
"""

from calib.procedure.answers import CertificateSection

__all__ = ["CertificateSection"]
