"""The measurements of ``rayfix evaluate``: cases, methods, studies, and their execution, storage and summary."""
