"""What turns docs/ into the site: hooks of mkdocs, and the pages that are made from the code and the contract."""
