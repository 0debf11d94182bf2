//! The USB link: one vendor-specific interface, requests on bulk OUT, replies on bulk IN, events
//! on interrupt IN (`stspp_protocol::usb`).

use crate::Irqs;
use crate::shared::{self, ReplySink};
use embassy_futures::yield_now;
use embassy_gd32f3x0::Peri;
use embassy_gd32f3x0::peripherals::{PA11, PA12, USBFS};
use embassy_gd32f3x0::reset;
use embassy_gd32f3x0::usb::{Config as DriverConfig, Driver, Endpoint, In, Out};
use embassy_usb::driver::{Endpoint as _, EndpointAddress, EndpointError, EndpointIn, EndpointOut};
use embassy_usb::msos::{
    CompatibleIdFeatureDescriptor, PropertyData, RegistryPropertyFeatureDescriptor, windows_version,
};
use embassy_usb::{Builder, Config, Handler, UsbDevice, UsbVersion};
use heapless::Vec;
use static_cell::StaticCell;
use stspp_protocol::usb as ids;
use stspp_protocol::version::SerialNumber;
use stspp_protocol::wire::MAX_FRAME_LEN;

type Device = UsbDevice<'static, Driver<'static>>;

/// What [`build`] makes, each for its task.
pub(crate) struct Usb {
    pub(crate) device: Device,
    pub(crate) requests: Endpoint<'static, Out>,
    pub(crate) replies: Endpoint<'static, In>,
    pub(crate) events: Endpoint<'static, In>,
}

/// Memory that the stack borrows for ever.
struct Buffers {
    out: [u8; 64 + ids::MAX_PACKET_LEN],
    config: [u8; 64],
    bos: [u8; 48],
    msos: [u8; 192],
    control: [u8; 128],
    serial: [u8; 24],
}

/// Describes the device.
pub(crate) fn build(
    usbfs: Peri<'static, USBFS>,
    dm: Peri<'static, PA11>,
    dp: Peri<'static, PA12>,
    irqs: Irqs,
) -> Usb {
    static BUFFERS: StaticCell<Buffers> = StaticCell::new();
    static HANDLER: StaticCell<LinkHandler> = StaticCell::new();
    let buffers = BUFFERS.init(Buffers {
        out: [0; _],
        config: [0; _],
        bos: [0; _],
        msos: [0; _],
        control: [0; _],
        serial: SerialNumber(reset::unique_id()).to_ascii(),
    });
    let driver = Driver::new(usbfs, dm, dp, irqs, &mut buffers.out, DriverConfig::default());

    let mut config = Config::new(ids::VENDOR_ID, ids::PRODUCT_ID);
    config.manufacturer = Some(ids::MANUFACTURER);
    config.product = Some(ids::PRODUCT);
    config.serial_number = core::str::from_utf8(&buffers.serial).ok();
    config.max_power = ids::MAX_POWER_MA;
    config.max_packet_size_0 = 64;
    // The class is the interface's, and BOS (for Windows) needs USB 2.1.
    config.device_class = 0;
    config.device_sub_class = 0;
    config.device_protocol = 0;
    config.composite_with_iads = false;
    config.bcd_usb = UsbVersion::TwoOne;

    let mut builder = Builder::new(
        driver,
        config,
        &mut buffers.config,
        &mut buffers.bos,
        &mut buffers.msos,
        &mut buffers.control,
    );
    // One interface, so the features are the device's: Windows then loads WinUSB by itself.
    builder.msos_descriptor(windows_version::WIN8_1, ids::MS_OS_VENDOR_CODE);
    builder.msos_feature(CompatibleIdFeatureDescriptor::new("WINUSB", ""));
    builder.msos_feature(RegistryPropertyFeatureDescriptor::new(
        "DeviceInterfaceGUIDs",
        PropertyData::RegMultiSz(&[ids::MS_OS_INTERFACE_GUID]),
    ));
    builder.handler(HANDLER.init(LinkHandler { configured: false }));

    let (class, subclass, protocol) =
        (ids::INTERFACE_CLASS, ids::INTERFACE_SUBCLASS, ids::INTERFACE_PROTOCOL);
    let mut function = builder.function(class, subclass, protocol);
    let mut interface = function.interface();
    let mut setting = interface.alt_setting(class, subclass, protocol, None);
    let address = |address: u8| Some(EndpointAddress::from(address));
    let packet = ids::MAX_PACKET_LEN as u16;
    let requests = setting.endpoint_bulk_out(address(ids::ENDPOINT_REQUESTS), packet);
    let replies = setting.endpoint_bulk_in(address(ids::ENDPOINT_REPLIES), packet);
    let events = setting.endpoint_interrupt_in(
        address(ids::ENDPOINT_EVENTS),
        packet,
        ids::EVENT_INTERVAL_MS,
    );
    drop(function);
    Usb { device: builder.build(), requests, replies, events }
}

/// Tells the controller whether a host is there.
struct LinkHandler {
    configured: bool,
}

impl LinkHandler {
    fn up(&self) {
        shared::with_controller(|c, now_us| c.on_link_up(now_us));
    }

    fn lost(&self) {
        shared::with_controller(|c, now_us| c.on_link_lost(now_us));
    }
}

impl Handler for LinkHandler {
    fn enabled(&mut self, enabled: bool) {
        if !enabled {
            self.lost();
        }
    }

    fn reset(&mut self) {
        self.configured = false;
        self.lost();
    }

    fn configured(&mut self, configured: bool) {
        self.configured = configured;
        if configured { self.up() } else { self.lost() }
    }

    fn suspended(&mut self, suspended: bool) {
        // A pulled cable is a suspended bus: there is no other sign of it.
        if suspended {
            self.lost();
        } else if self.configured {
            self.up();
        }
    }
}

/// Control endpoint and bus events.
#[embassy_executor::task]
pub(crate) async fn device(mut device: Device) -> ! {
    device.run().await
}

/// Writes a frame as packets. Where it fills its last packet, an empty one ends the transfer.
async fn write(endpoint: &mut Endpoint<'static, In>, frame: &[u8]) -> Result<(), EndpointError> {
    for packet in frame.chunks(ids::MAX_PACKET_LEN) {
        endpoint.write(packet).await?;
    }
    if frame.len().is_multiple_of(ids::MAX_PACKET_LEN) {
        endpoint.write(&[]).await?;
    }
    Ok(())
}

struct Replies {
    endpoint: Endpoint<'static, In>,
}

impl ReplySink for Replies {
    async fn send(&mut self, frame: &[u8]) {
        if write(&mut self.endpoint, frame).await.is_err() {
            defmt::debug!("usb: reply dropped, the host is gone");
        }
    }
}

/// Requests and replies.
#[embassy_executor::task]
pub(crate) async fn link(mut requests: Endpoint<'static, Out>, replies: Endpoint<'static, In>) {
    let mut bytes = [0; ids::MAX_PACKET_LEN];
    let mut replies = Replies { endpoint: replies };
    loop {
        requests.wait_enabled().await;
        while let Ok(count) = requests.read(&mut bytes).await {
            shared::serve(&bytes[..count], &mut replies).await;
            // However fast the host is, the other tasks get their turn.
            yield_now().await;
        }
    }
}

/// Events. Those that have queued up share a packet: the host polls once a millisecond, and at the
/// highest slot rate there is an event in each.
#[embassy_executor::task]
pub(crate) async fn events(mut endpoint: Endpoint<'static, In>) {
    let mut frame = [0; MAX_FRAME_LEN];
    let mut held = 0;
    let mut transfer: Vec<u8, MAX_FRAME_LEN> = Vec::new();
    loop {
        endpoint.wait_enabled().await;
        if held == 0 {
            held = shared::next_event(&mut frame).await;
        }
        transfer.clear();
        while held != 0 && (transfer.is_empty() || transfer.len() + held <= ids::MAX_PACKET_LEN) {
            // There is room: for one frame of any length, or for what fits a packet.
            let _ = transfer.extend_from_slice(&frame[..held]);
            held = shared::take_event(&mut frame).unwrap_or(0);
        }
        if write(&mut endpoint, &transfer).await.is_err() {
            defmt::debug!("usb: events dropped, the host is gone");
        }
    }
}
