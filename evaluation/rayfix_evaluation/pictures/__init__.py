"""Pictures of fixes and reports for papers, and the files that they are written to."""
