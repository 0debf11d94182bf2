//! What the firmware touched that the models do not have.

use std::collections::BTreeMap;

use super::registers::register_at;

/// An access that a model could not honour.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Unmodelled {
    /// Register and fields by the SVD's names, and what is missing.
    pub what: String,
    /// How often.
    pub count: u64,
    /// Cycle of the first such access.
    pub first_cycle: u64,
}

/// The list of unmodelled accesses, each named once.
#[derive(Debug, Default)]
pub struct AccessLog {
    entries: BTreeMap<String, (u64, u64)>,
}

impl AccessLog {
    /// Notes an access in the log's own words.
    pub fn note(&mut self, cycle: u64, what: String) {
        self.entries.entry(what).or_insert((0, cycle)).0 += 1;
    }

    /// Notes a read of a register that no model has.
    pub fn read(&mut self, cycle: u64, address: u32) {
        let name = register_name(address);
        self.note(cycle, format!("{name} read: not modelled"));
    }

    /// Notes a write of `value`, of whose bits only those in `modelled` have a model; bits at their
    /// reset value are no loss.
    pub fn write(&mut self, cycle: u64, address: u32, value: u32, modelled: Option<u32>) {
        let Some(mask) = modelled else {
            let name = register_name(address);
            self.note(cycle, format!("{name} written: not modelled"));
            return;
        };
        let register = register_at(address);
        let lost = (value ^ register.map_or(0, |r| r.reset)) & !mask;
        if lost != 0 {
            let name = register_name(address);
            let fields = register
                .map_or_else(|| format!("bits {lost:#x}"), |r| r.fields_in(lost).join(", "));
            self.note(cycle, format!("{name} field {fields} written: not modelled"));
        }
    }

    /// The accesses so far, by name.
    #[must_use]
    pub fn list(&self) -> Vec<Unmodelled> {
        self.entries
            .iter()
            .map(|(what, (count, first_cycle))| Unmodelled {
                what: what.clone(),
                count: *count,
                first_cycle: *first_cycle,
            })
            .collect()
    }

    /// Forgets all entries.
    pub fn clear(&mut self) {
        self.entries.clear();
    }
}

fn register_name(address: u32) -> String {
    register_at(address).map_or_else(|| format!("address {address:#010x}"), |r| r.name.clone())
}
