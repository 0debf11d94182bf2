//! `docs/protocol.md` says what the types say.

use stspp_protocol::message::MESSAGE_TABLE;
use stspp_protocol::timing::Limits;
use stspp_protocol::usb;
use stspp_protocol::version::PROTOCOL_VERSION;
use stspp_protocol::wire::{MAX_FRAME_LEN, MAX_PACKET_LEN};

const DOC: &str = include_str!("../../docs/protocol.md");

/// What stands between `<!-- table: NAME -->` and `<!-- end -->`.
fn section(name: &str) -> &'static str {
    let (_, rest) = DOC.split_once(&format!("<!-- table: {name} -->\n")).expect(name);
    rest.split_once("<!-- end -->").expect("<!-- end -->").0
}

fn messages() -> String {
    let mut table = String::from("| Id | Request | Reply | |\n|---|---|---|---|\n");
    for row in MESSAGE_TABLE.iter().filter(|row| !row.reply.is_empty()) {
        let (id, name, reply, purpose) = (row.id, row.name, row.reply, row.purpose);
        table += &format!("| 0x{id:02X} | `{name}` | `{reply}` | {purpose} |\n");
    }
    table += "\n| Id | Event | |\n|---|---|---|\n";
    for row in MESSAGE_TABLE.iter().filter(|row| row.reply.is_empty()) {
        let (id, name, purpose) = (row.id, row.name, row.purpose);
        table += &format!("| 0x{id:02X} | `{name}` | {purpose} |\n");
    }
    table
}

fn limits() -> String {
    // Taken apart by name: a new limit does not compile until it is documented.
    let Limits {
        max_slots,
        projector_count,
        max_simultaneous_projectors,
        has_floodlight,
        tick_ns,
        min_frame_period_us,
        max_frame_period_us,
        min_exposure_us,
        max_gate_margin_us,
        max_on_time_us,
        min_dead_time_us,
        max_projector_duty_permille,
        max_floodlight_duty_permille,
        max_floodlight_on_us,
        duty_window_us,
        heartbeat_timeout_us,
        max_temperature_dc,
    } = Limits::F350;
    let rows = [
        ("max_slots", u32::from(max_slots), "length of the slot table"),
        ("projector_count", u32::from(projector_count), "projectors fitted"),
        (
            "max_simultaneous_projectors",
            u32::from(max_simultaneous_projectors),
            "projectors lit in one slot",
        ),
        ("has_floodlight", u32::from(has_floodlight), "whether there is a floodlight"),
        ("tick_ns", tick_ns, "resolution of the gate timer"),
        ("min_frame_period_us", min_frame_period_us, "shortest slot"),
        ("max_frame_period_us", max_frame_period_us, "longest slot"),
        ("min_exposure_us", min_exposure_us, "shortest exposure"),
        ("max_gate_margin_us", max_gate_margin_us, "longest gate lead, gate lag"),
        ("max_on_time_us", max_on_time_us, "longest time a gate is on within a slot"),
        ("min_dead_time_us", min_dead_time_us, "shortest time from gate off to the next gate on"),
        (
            "max_projector_duty_permille",
            u32::from(max_projector_duty_permille),
            "share of the time that one projector is on",
        ),
        (
            "max_floodlight_duty_permille",
            u32::from(max_floodlight_duty_permille),
            "share of the time that the floodlight is on",
        ),
        ("max_floodlight_on_us", max_floodlight_on_us, "longest `FloodlightOn`"),
        ("duty_window_us", duty_window_us, "window of the duty budget"),
        ("heartbeat_timeout_us", heartbeat_timeout_us, "silence of the host that is a fault"),
        (
            "max_temperature_dc",
            max_temperature_dc.unsigned_abs().into(),
            "temperature that is a fault, tenths of a degree Celsius",
        ),
    ];
    let mut table = String::from("| Limit | F330, F350 | |\n|---|---:|---|\n");
    for (name, value, meaning) in rows {
        table += &format!("| `{name}` | {value} | {meaning} |\n");
    }
    table
}

#[test]
fn the_message_table_is_the_types() {
    assert_eq!(section("messages"), messages(), "put this there:\n{}", messages());
}

#[test]
fn the_limits_are_the_boards() {
    assert_eq!(Limits::F330, Limits::F350, "one column serves both boards");
    assert_eq!(section("limits"), limits(), "put this there:\n{}", limits());
}

#[test]
fn the_numbers_in_the_prose_are_right() {
    for text in [
        format!("This is protocol {PROTOCOL_VERSION}."),
        format!("At most {MAX_PACKET_LEN} bytes before COBS, {MAX_FRAME_LEN} on the wire"),
        format!("bulk OUT 0x{:02X}", usb::ENDPOINT_REQUESTS),
        format!("bulk IN 0x{:02X}", usb::ENDPOINT_REPLIES),
        format!("interrupt IN 0x{:02X}", usb::ENDPOINT_EVENTS),
        format!(
            "class {:02X}, subclass {:02X}, protocol {:02X}",
            usb::INTERFACE_CLASS,
            usb::INTERFACE_SUBCLASS,
            usb::INTERFACE_PROTOCOL
        ),
        format!("{} Mbaud", usb::SERIAL_BAUD / 1_000_000),
        format!("modulo {}", usb::SOF_MODULUS),
    ] {
        assert!(DOC.contains(&text), "docs/protocol.md does not say: {text}");
    }
    // The frames shown are the frozen ones.
    let shown: String = DOC.chars().filter(|character| !character.is_whitespace()).collect();
    let frozen = include_str!("frozen_bytes.txt");
    for name in ["REQ_HEARTBEAT ", "REP_HEARTBEAT "] {
        let bytes = frozen.lines().find_map(|line| line.strip_prefix(name)).expect(name);
        assert!(shown.contains(bytes), "docs/protocol.md does not show {bytes}");
    }
}
