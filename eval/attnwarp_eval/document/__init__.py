"""Documents: sections, tables, figures and pictures, written as Markdown and as one HTML file."""
