"""Messages between processes of a host: pipes, registers, mailboxes, group reductions."""
