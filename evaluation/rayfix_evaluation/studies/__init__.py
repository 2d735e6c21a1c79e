"""What ``rayfix evaluate`` measures: cases, methods, studies, and how they are run, stored and summed up."""
