"""Where the deployment's files are."""

import sys

from tests.support.checkout import ROOT

# The scripts of the images import each other, as they do when they are run.
sys.path[:0] = [str(ROOT / "docker"), str(ROOT / "docker/stages")]
