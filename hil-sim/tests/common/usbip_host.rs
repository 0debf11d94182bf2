//! The host's side of USB/IP over loopback, for tests: what goes wrong ends the test.
#![allow(dead_code, reason = "each test binary uses its part")]

use stspp_hil_sim::front::usbip::client::{self, Client, Transfer};

pub struct Host(pub Client);

/// Status and data of a reply.
pub type Reply = (i32, Vec<u8>);

impl Host {
    pub fn connect(port: u16) -> Self {
        Self(Client::connect(("127.0.0.1", port)).unwrap())
    }

    pub fn bytes(&mut self, count: usize) -> Vec<u8> {
        self.0.bytes(count).unwrap()
    }

    pub fn import(&mut self, bus_id: &str) -> Option<Vec<u8>> {
        self.0.import(bus_id).unwrap()
    }

    pub fn send(
        &mut self,
        is_in: bool,
        endpoint: u32,
        length: usize,
        setup: [u8; 8],
        data: &[u8],
    ) -> u32 {
        let endpoint = endpoint as u8;
        self.0.submit(&Transfer { is_in, endpoint, length, setup, data }).unwrap()
    }

    /// Kind, sequence number of the command, status and data.
    pub fn reply(&mut self) -> (u32, u32, Reply) {
        let client::Reply { is_unlink, sequence, status, data } = self.0.reply().unwrap();
        (if is_unlink { 4 } else { 3 }, sequence, (status, data))
    }

    pub fn control(&mut self, setup: [u8; 8], data: &[u8]) -> Reply {
        let reply = self.0.control(setup, data).unwrap();
        (reply.status, reply.data)
    }

    pub fn unlink(&mut self, victim: u32) -> u32 {
        self.0.unlink(victim).unwrap()
    }
}
