"""Take the folder kernels/ into the package as it is built; all else is in setup.cfg."""

import os
import tempfile
from glob import glob

from setuptools import setup
from setuptools.command.build_py import build_py


class BuildWithKernels(build_py):
    """Modules and kernels. An editable install has both from the clone."""

    def run(self):
        """Copy them."""
        super().run()
        if not self.editable_mode:
            self.mkpath(f"{self.build_lib}/lnocl/kernels")
            for file in glob("kernels/*.cl"):
                self.copy_file(file, f"{self.build_lib}/lnocl/kernels")


with tempfile.TemporaryDirectory() as folder:
    # A clone that cannot be written to is built elsewhere.
    elsewhere = {"egg_info": {"egg_base": folder}, "build": {"build_base": folder}}
    options = {} if os.access(".", os.W_OK) else elsewhere
    setup(cmdclass={"build_py": BuildWithKernels}, options=options)
