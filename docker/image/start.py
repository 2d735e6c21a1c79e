"""First program of the images' containers: ``start.py ARGUMENT ...`` becomes ``rayfix ARGUMENT ...``.

``RAYFIX_MODULE`` names another module to become, such as ``dask`` for the workers of a cluster.

numba takes compiled kernels only from a folder that it can write to, and a container's root may be read-only. So the
kernels that the image was built with are copied to the temporary folder, some 4 MB, and rayfix starts from there.
"""

import os
import shutil
import sys

kernels, cache = os.environ["RAYFIX_KERNELS"], os.environ["NUMBA_CACHE_DIR"]
try:
    shutil.copytree(kernels, cache, copy_function=shutil.copyfile, dirs_exist_ok=True)
except OSError as error:
    folder = os.path.dirname(cache)
    sys.exit(f"rayfix: cannot write {cache} ({error}); mount a writable folder at {folder}, e.g. --tmpfs {folder}")
os.execv(sys.executable, [sys.executable, "-m", os.environ.get("RAYFIX_MODULE", "rayfix"), *sys.argv[1:]])
