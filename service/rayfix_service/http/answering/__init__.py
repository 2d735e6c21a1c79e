"""From a request to its answer: the tables that are served, fixes within their time, and the feed of fixes."""
