"""Pictures of fixes and reports for papers, and their files."""
