//! The other side: a host that attaches a device and asks for transfers, as a kernel's host controller
//! does. Tests speak to the server with it, and `hil-sim bench` measures the server with it.

use std::io::{self, Read, Write};
use std::net::{TcpStream, ToSocketAddrs};
use std::time::Duration;

use super::wire;

/// Longest wait for the server.
const PATIENCE: Duration = Duration::from_secs(10);

/// A connection to a server.
pub struct Client {
    /// The socket, for what is not USB/IP.
    pub stream: TcpStream,
    sequence: u32,
    /// Transfers from the device that are not answered yet.
    inward: Vec<u32>,
}

/// What a command came to.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Reply {
    /// Whether it answers an unlink instead of a transfer.
    pub is_unlink: bool,
    /// Sequence number of the command.
    pub sequence: u32,
    /// 0 or a negative errno.
    pub status: i32,
    /// Bytes from the device.
    pub data: Vec<u8>,
}

/// A transfer to ask for.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Transfer<'a> {
    /// Whether data comes from the device.
    pub is_in: bool,
    /// Endpoint number without direction.
    pub endpoint: u8,
    /// Length of the buffer.
    pub length: usize,
    /// Setup packet of a control transfer.
    pub setup: [u8; 8],
    /// Data to the device.
    pub data: &'a [u8],
}

impl Client {
    /// Connects to a server.
    ///
    /// # Errors
    /// The socket's.
    pub fn connect(address: impl ToSocketAddrs) -> io::Result<Self> {
        let stream = TcpStream::connect(address)?;
        stream.set_read_timeout(Some(PATIENCE))?;
        stream.set_nodelay(true)?;
        Ok(Self { stream, sequence: 0, inward: Vec::new() })
    }

    /// Reads so many bytes.
    ///
    /// # Errors
    /// The socket's; nothing for ten seconds is one.
    pub fn bytes(&mut self, count: usize) -> io::Result<Vec<u8>> {
        let mut bytes = vec![0; count];
        self.stream.read_exact(&mut bytes)?;
        Ok(bytes)
    }

    /// Asks for a device; its record, or `None` when it is refused.
    ///
    /// # Errors
    /// The socket's.
    pub fn import(&mut self, bus_id: &str) -> io::Result<Option<Vec<u8>>> {
        let mut request = wire::operation_header(wire::OP_REQ_IMPORT, true);
        request.extend(bus_id.as_bytes());
        request.resize(8 + 32, 0);
        self.stream.write_all(&request)?;
        let head = self.bytes(8)?;
        if head[7] == 0 { self.bytes(312).map(Some) } else { Ok(None) }
    }

    /// Asks for a transfer; its sequence number.
    ///
    /// # Errors
    /// The socket's.
    pub fn submit(&mut self, transfer: &Transfer<'_>) -> io::Result<u32> {
        self.sequence += 1;
        let mut command = wire::submit_command(self.sequence, transfer);
        command.extend(transfer.data);
        self.stream.write_all(&command)?;
        if transfer.is_in {
            self.inward.push(self.sequence);
        }
        Ok(self.sequence)
    }

    /// Gives up a transfer; the sequence number of that command.
    ///
    /// # Errors
    /// The socket's.
    pub fn unlink(&mut self, victim: u32) -> io::Result<u32> {
        self.sequence += 1;
        self.stream.write_all(&wire::unlink_command(self.sequence, victim))?;
        Ok(self.sequence)
    }

    /// The next reply.
    ///
    /// # Errors
    /// The socket's.
    pub fn reply(&mut self) -> io::Result<Reply> {
        let wire::ReplyHead { is_unlink, sequence, status, length } =
            wire::read_reply(&mut self.stream)?;
        // Only what comes from the device has data behind it.
        let data = match self.inward.iter().position(|known| *known == sequence) {
            Some(at) if !is_unlink => {
                self.inward.remove(at);
                self.bytes(length)?
            }
            _ => Vec::new(),
        };
        Ok(Reply { is_unlink, sequence, status, data })
    }

    /// A control transfer with nothing else under way.
    ///
    /// # Errors
    /// The socket's, and `InvalidData` for the answer to something else.
    pub fn control(&mut self, setup: [u8; 8], data: &[u8]) -> io::Result<Reply> {
        let is_in = setup[0] & 0x80 != 0;
        let length = usize::from(u16::from_le_bytes([setup[6], setup[7]]));
        let sequence = self.submit(&Transfer { is_in, endpoint: 0, length, setup, data })?;
        let reply = self.reply()?;
        if reply.sequence == sequence && !reply.is_unlink {
            Ok(reply)
        } else {
            Err(wire::invalid("another transfer was answered"))
        }
    }
}
