"""How a report is drawn: HTML page, PDF, Markdown, tables, and the figures as SVG or images."""
