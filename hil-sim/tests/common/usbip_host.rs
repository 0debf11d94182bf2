//! A USB/IP client over loopback, as a kernel's host controller would speak.
#![allow(dead_code, reason = "each test binary uses its part")]

use std::io::{Read, Write};
use std::net::TcpStream;
use std::time::Duration;

pub struct Host {
    pub stream: TcpStream,
    sequence: u32,
}

/// Status and data of a reply.
pub type Reply = (i32, Vec<u8>);

impl Host {
    pub fn connect(port: u16) -> Self {
        let stream = TcpStream::connect(("127.0.0.1", port)).unwrap();
        stream.set_read_timeout(Some(Duration::from_secs(10))).unwrap();
        stream.set_nodelay(true).unwrap();
        Self { stream, sequence: 0 }
    }

    pub fn bytes(&mut self, count: usize) -> Vec<u8> {
        let mut bytes = vec![0; count];
        self.stream.read_exact(&mut bytes).unwrap();
        bytes
    }

    pub fn import(&mut self, bus_id: &str) -> Option<Vec<u8>> {
        let mut request = vec![1, 0x11, 0x80, 0x03, 0, 0, 0, 0];
        request.extend(bus_id.as_bytes());
        request.resize(8 + 32, 0);
        self.stream.write_all(&request).unwrap();
        let head = self.bytes(8);
        (head[7] == 0).then(|| self.bytes(312))
    }

    pub fn send(
        &mut self,
        is_in: bool,
        endpoint: u32,
        length: usize,
        setup: [u8; 8],
        data: &[u8],
    ) -> u32 {
        self.sequence += 1;
        let fields =
            [1, self.sequence, 0x10001, u32::from(is_in), endpoint, 0, length as u32, 0, 0, 0];
        let mut command: Vec<u8> = fields.iter().flat_map(|f: &u32| f.to_be_bytes()).collect();
        command.extend(setup);
        command.extend(data);
        self.stream.write_all(&command).unwrap();
        self.sequence
    }

    pub fn reply(&mut self, is_in: bool) -> (u32, u32, Reply) {
        let head = self.bytes(48);
        let word = |at: usize| u32::from_be_bytes(head[at..at + 4].try_into().unwrap());
        let data = if word(0) == 3 && is_in { self.bytes(word(24) as usize) } else { vec![] };
        (word(0), word(4), (word(20) as i32, data))
    }

    pub fn control(&mut self, setup: [u8; 8], data: &[u8]) -> Reply {
        let is_in = setup[0] & 0x80 != 0;
        let length = usize::from(u16::from_le_bytes([setup[6], setup[7]]));
        let sequence = self.send(is_in, 0, length, setup, data);
        let (kind, answered, reply) = self.reply(is_in);
        assert_eq!((kind, answered), (3, sequence));
        reply
    }

    /// Gives up a transfer; returns the sequence number of that command.
    pub fn unlink(&mut self, victim: u32) -> u32 {
        self.sequence += 1;
        let fields = [2, self.sequence, 0, 0, 0, victim];
        let mut command: Vec<u8> = fields.iter().flat_map(|f: &u32| f.to_be_bytes()).collect();
        command.resize(48, 0);
        self.stream.write_all(&command).unwrap();
        self.sequence
    }
}
