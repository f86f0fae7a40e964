"""One solve on several processes: vectors spread over them, and what starts them."""
