"""The online half: a report and a table become a position, in Python (``fusion``) and over HTTP (``http``)."""
