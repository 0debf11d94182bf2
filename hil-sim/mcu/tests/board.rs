//! What the firmware makes of a board that is not as it should be: no crystal, or another chip.

mod common;

use stspp_hil_mcu::chip::Chip;
use stspp_hil_mcu::controller::McuController;
use stspp_hil_mcu::defmt_log::DefmtLog;
use stspp_hil_mcu::measure::faults::light_up;
use stspp_hil_mcu::measure::timing::{is_projector, pulses};
use stspp_hil_mcu::session::Session;
use stspp_hil_mcu::soc::Variant;
use stspp_hil_mcu::soc::pins::{Level, Pin};
use stspp_protocol::fault::FaultReason;
use stspp_protocol::message::{FromDevice, Reply, Request};
use stspp_protocol::reply::RequestError;
use stspp_protocol::request::{Arm, ClearFaults, GetFaults, Hello};
use stspp_protocol::timing::ProjectionTiming;
use stspp_protocol::usb::SERIAL_BAUD;
use stspp_protocol::version::PROTOCOL_VERSION;
use stspp_protocol::wire::{FrameDecoder, MAX_FRAME_LEN};

/// Without its crystal the firmware falls back to the internal oscillators, says so in its log, and
/// works: USB (trimmed by the host's frames), UART, and slots.
#[test]
fn a_board_without_its_crystal_falls_back_and_says_so() {
    for variant in common::BOARDS {
        let Some(image) = common::image(variant) else { continue };
        let mut chip = Chip::new(variant, &image);
        chip.set_crystal(false);
        let controller = McuController::on_chip(chip, image.clone())
            .unwrap_or_else(|error| panic!("{variant:?}: {error}"));
        let mut session = Session::new(controller);
        // The crystal is given 200 ms.
        session.run_for(500_000_000);
        let log = common::log(&mut session);
        assert!(log.iter().any(|line| line.contains("crystal does not start")), "{log:#?}");
        let hclk_hz = session.controller.chip().hclk_hz();
        let expected_hz = if variant == Variant::F330 { 84_000_000 } else { 96_000_000 };
        assert_eq!(hclk_hz, expected_hz, "{variant:?}");
        light_up(&mut session, &ProjectionTiming::default()).unwrap();
        session.take_edges();
        session.run_for(400_000_000);
        let gates = pulses(&session.take_edges(), is_projector);
        assert!(gates.len() >= 11, "{variant:?}: {} slots", gates.len());
        println!("{variant:?} without a crystal: {hclk_hz} Hz, {} slots in 0.4 s", gates.len());
        common::assert_all_modelled(&mut session);
    }
}

fn gates() -> impl Iterator<Item = Pin> {
    (0..=10).map(|number| Pin { port: 1, number })
}

/// Calls a request over the UART of a bare chip.
fn call(chip: &mut Chip, request: &Request) -> Result<Reply, RequestError> {
    let mut out = [0; MAX_FRAME_LEN];
    let bytes = request.encode(7, &mut out).unwrap();
    chip.soc().usarts[0].take_sent();
    chip.act(|soc, cx| soc.usarts[0].host_send(bytes, cx));
    chip.run_for_ns(20_000_000);
    let sent: Vec<u8> = chip.soc().usarts[0].take_sent().into_iter().map(|s| s.byte).collect();
    let mut decoder = FrameDecoder::new();
    let mut rest = &sent[..];
    while let Some(frame) = decoder.next_frame(&mut rest) {
        let Ok(frame) = frame else { continue };
        if let Ok(FromDevice::Reply { seq: 7, reply }) = FromDevice::decode(&frame) {
            return reply;
        }
    }
    panic!("no reply to {request:?}");
}

/// The image of the F330 on an F350: its link works, and tells what is wrong; there is no light.
#[test]
fn the_f330s_image_on_an_f350_refuses_light_and_says_why() {
    let Some(image) = common::image(Variant::F330) else { return };
    let mut chip = Chip::new(Variant::F350, &image);
    chip.soc().usarts[0].set_host_baud(SERIAL_BAUD);
    chip.drive_pin(Pin { port: 0, number: 0 }, Some(true));
    chip.soc().adc.set_volts(4, stspp_hil_mcu::board::thermistor_volts(25.0));
    chip.run_for_ns(50_000_000);
    call(&mut chip, &Request::Hello(Hello { host: PROTOCOL_VERSION })).unwrap();
    // Its cause does not go away.
    call(&mut chip, &Request::ClearFaults(ClearFaults)).unwrap();
    let Ok(Reply::GetFaults(faults)) = call(&mut chip, &Request::GetFaults(GetFaults)) else {
        panic!("another reply")
    };
    assert!(faults.latched.contains(FaultReason::WrongBoard), "{faults:?}");
    let first = faults.first.expect("a record");
    assert_eq!((first.reason, first.value, first.limit), (FaultReason::WrongBoard, 1, 0));
    let armed = call(&mut chip, &Request::Arm(Arm));
    assert!(matches!(armed, Err(RequestError::Faulted { .. })), "{armed:?}");
    println!("F330's image on an F350: {}", armed.unwrap_err());
    assert!(gates().all(|pin| chip.pin_level(pin) == Level::Low));
    assert_eq!(chip.resets().len(), 1, "it goes on, dark");
}

/// The image of the F350 on an F330: there is no link; it stays dark, runs, blinks and logs.
#[test]
fn the_f350s_image_on_an_f330_stays_dark_and_says_why() {
    let Some(image) = common::image(Variant::F350) else { return };
    let mut chip = Chip::new(Variant::F330, &image);
    chip.drive_pin(Pin { port: 0, number: 0 }, Some(true));
    chip.soc().adc.set_volts(4, stspp_hil_mcu::board::thermistor_volts(25.0));
    chip.run_for_ns(2_000_000_000);
    let log = DefmtLog::new(&image).expect("a log").read(&mut chip);
    println!("F350's image on an F330: {log:?}");
    assert!(log.iter().any(|line| line.contains("this firmware is for the GD32F350")), "{log:#?}");
    assert_eq!(chip.resets().len(), 1, "no reset loop: {:?}", chip.resets());
    let changes = chip.take_pin_changes();
    assert!(changes.iter().all(|c| c.level != Level::High || gates().all(|gate| gate != c.pin)));
    // The LED blinks fast: a fault.
    let led = Pin { port: 2, number: 13 };
    let blinks = changes.iter().filter(|c| c.pin == led && c.level == Level::High).count();
    assert!((8..=12).contains(&blinks), "{blinks} blinks in two seconds");
}
