//! Which device is meant.

use std::{collections::BTreeSet, fmt, str::FromStr};

use super::{DeviceDescription, DeviceError, DeviceKind};

/// Which device to open.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum DeviceChoice {
    /// The best that is no software: discrete before integrated before the others.
    Auto,
    /// By its number in [`devices`](super::devices).
    Index(usize),
    /// The one of this name, else the only one whose name contains it, upper and lower case alike. A device that several
    /// drivers offer counts once.
    Name(String),
    /// The one that was here before: numbers shift when a device falls off its bus.
    Itself {
        /// [`DeviceDescription::label`].
        label: String,
        /// [`DeviceDescription::pci_bus`].
        pci_bus: String,
        /// Its number then, which tells those apart that are alike in all else.
        index: usize,
    },
}

impl FromStr for DeviceChoice {
    type Err = DeviceError;

    /// As people write one of them, upper and lower case alike: `gpu` the best, `gpu:N` by its number, everything else by its name.
    fn from_str(text: &str) -> Result<Self, DeviceError> {
        let (name, lower) = (text.trim(), text.trim().to_lowercase());
        match (lower.as_str(), lower.strip_prefix("gpu:").map(str::parse)) {
            ("", _) | (_, Some(Err(_))) => Err(DeviceError::Unreadable { text: text.to_owned() }),
            ("gpu", _) => Ok(Self::Auto),
            (_, Some(Ok(index))) => Ok(Self::Index(index)),
            (_, None) => Ok(Self::Name(name.to_owned())),
        }
    }
}

impl fmt::Display for DeviceChoice {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Auto => write!(f, "gpu"),
            Self::Index(index) => write!(f, "gpu:{index}"),
            Self::Name(name) => write!(f, "{name}"),
            Self::Itself { label, pci_bus, .. } if pci_bus.is_empty() => write!(f, "{label}"),
            Self::Itself { label, pci_bus, .. } => write!(f, "{label} at {pci_bus}"),
        }
    }
}

/// Those of `devices` that [`DeviceChoice::Auto`] would choose among, the best first: of the best kind there is, each
/// device once even if several drivers offer it. Empty where there is only software.
pub fn real_gpus(devices: &[DeviceDescription]) -> Vec<&DeviceDescription> {
    let ranked = devices.iter().filter_map(|device| Some((device.kind.preference()?, device.index, device)));
    let Some((_, _, best)) = ranked.min_by_key(|(preference, index, _)| (*preference, *index)) else {
        return Vec::new();
    };
    let mut places = BTreeSet::new();
    devices
        .iter()
        .filter(|device| device.kind == best.kind && device.backend == best.backend)
        .filter(|device| device.pci_bus.is_empty() || places.insert(&device.pci_bus))
        .collect()
}

/// The device that a choice means.
pub fn choose<'a>(
    choice: &DeviceChoice,
    devices: &'a [DeviceDescription],
) -> Result<&'a DeviceDescription, DeviceError> {
    let found = match choice {
        DeviceChoice::Auto => real_gpus(devices).first().copied(),
        DeviceChoice::Index(index) => devices.get(*index),
        DeviceChoice::Name(name) => named(name, devices)?,
        DeviceChoice::Itself { label, pci_bus, index } => {
            let same = devices.iter().filter(|device| device.label() == *label && device.pci_bus == *pci_bus);
            same.min_by_key(|device| device.index.abs_diff(*index))
        }
    };
    found.ok_or_else(|| DeviceError::NotFound { choice: choice.clone(), found: listed(devices) })
}

fn named<'a>(
    name: &str,
    devices: &'a [DeviceDescription],
) -> Result<Option<&'a DeviceDescription>, DeviceError> {
    let wanted = name.to_lowercase();
    let with = |fits: &dyn Fn(&str) -> bool| -> Vec<&'a DeviceDescription> {
        let mut fitting: Vec<_> = devices.iter().filter(|device| fits(&device.name.to_lowercase())).collect();
        let backend = fitting.first().map(|device| &device.backend);
        fitting.retain(|device| Some(&device.backend) == backend);
        fitting
    };
    let exact = with(&|name| name == wanted);
    let fitting = if exact.is_empty() { with(&|name| name.contains(&wanted)) } else { exact };
    match fitting.as_slice() {
        [] => Ok(None),
        [one] => Ok(Some(one)),
        several => {
            let several: Vec<_> = several.iter().map(|device| (*device).clone()).collect();
            Err(DeviceError::Ambiguous { name: name.to_owned(), found: listed(&several) })
        }
    }
}

fn listed(devices: &[DeviceDescription]) -> String {
    if devices.is_empty() {
        return "none (is a Vulkan, Metal or DirectX 12 driver installed?)".to_owned();
    }
    let one = |device: &DeviceDescription| {
        let software =
            if device.kind == DeviceKind::Software { ", software: only by its name or number" } else { "" };
        format!("gpu:{} {} ({}{software})", device.index, device.name, device.backend)
    };
    devices.iter().map(one).collect::<Vec<_>>().join("; ")
}

#[cfg(test)]
mod tests {
    use super::*;

    fn device(index: usize, name: &str, kind: DeviceKind) -> DeviceDescription {
        DeviceDescription {
            index,
            name: name.to_owned(),
            kind,
            backend: "vulkan".to_owned(),
            driver: String::new(),
            pci_bus: String::new(),
            memory: None,
            max_binding: 0,
            features: Vec::new(),
        }
    }

    fn chosen(choice: &DeviceChoice, devices: &[DeviceDescription]) -> Option<usize> {
        choose(choice, devices).ok().map(|device| device.index)
    }

    fn by_name(name: &str) -> DeviceChoice {
        DeviceChoice::Name(name.to_owned())
    }

    #[test]
    fn auto_takes_the_best_card_and_never_software() {
        let software = device(0, "llvmpipe", DeviceKind::Software);
        assert_eq!(chosen(&DeviceChoice::Auto, &[]), None);
        assert_eq!(chosen(&DeviceChoice::Auto, std::slice::from_ref(&software)), None);
        let all = [
            software,
            device(1, "built in", DeviceKind::Integrated),
            device(2, "Card A", DeviceKind::Discrete),
            device(3, "Card B", DeviceKind::Discrete),
        ];
        assert_eq!(chosen(&DeviceChoice::Auto, &all), Some(2));
        assert_eq!(chosen(&by_name("card b"), &all), Some(3));
        assert_eq!(chosen(&by_name("llvm"), &all), Some(0));
        assert_eq!(chosen(&by_name("card c"), &all), None);
        assert_eq!(chosen(&DeviceChoice::Index(1), &all), Some(1));
        assert_eq!(chosen(&DeviceChoice::Index(4), &all), None);
        let cards: Vec<_> = real_gpus(&all).iter().map(|device| device.index).collect();
        assert_eq!(cards, [2, 3], "graphics of the processor do not join the cards");
        assert_eq!(real_gpus(&all[..2])[0].index, 1);
        assert!(real_gpus(&all[..1]).is_empty());
    }

    #[test]
    fn a_name_that_fits_several_is_refused_with_their_numbers() {
        let all =
            [device(0, "Card A", DeviceKind::Discrete), device(1, "Card A Super", DeviceKind::Discrete)];
        assert_eq!(chosen(&by_name("card a"), &all), Some(0), "the whole name");
        let refused = choose(&by_name("card"), &all).map(|device| device.index);
        let Err(error @ DeviceError::Ambiguous { .. }) = refused else { panic!("{refused:?}") };
        let text = error.to_string();
        assert!(text.contains("gpu:0 Card A") && text.contains("gpu:1 Card A Super"), "{text}");
    }

    #[test]
    fn a_card_that_two_drivers_offer_counts_once() {
        let vulkan = device(0, "Card A", DeviceKind::Discrete);
        let again = DeviceDescription { index: 1, backend: "dx12".to_owned(), ..vulkan.clone() };
        let all = [vulkan, again];
        assert_eq!(chosen(&by_name("card"), &all), Some(0));
        assert_eq!(real_gpus(&all).len(), 1);
        assert_eq!(chosen(&DeviceChoice::Index(1), &all), Some(1));
        let at = |index, driver: &str, pci_bus: &str| DeviceDescription {
            driver: driver.to_owned(),
            pci_bus: pci_bus.to_owned(),
            ..device(index, "Card A", DeviceKind::Discrete)
        };
        let twice =
            [at(0, "one", "0000:01:00.0"), at(1, "other", "0000:01:00.0"), at(2, "one", "0000:02:00.0")];
        let cards: Vec<_> = real_gpus(&twice).iter().map(|device| device.index).collect();
        assert_eq!(cards, [0, 2]);
    }

    #[test]
    fn a_device_is_found_again_under_another_number_and_no_other_in_its_place() {
        let at = |index, pci_bus: &str| DeviceDescription {
            pci_bus: pci_bus.to_owned(),
            ..device(index, "Card A", DeviceKind::Discrete)
        };
        let before =
            [at(0, "0000:01:00.0"), at(1, "0000:02:00.0"), device(2, "llvmpipe", DeviceKind::Software)];
        let after = [at(0, "0000:02:00.0"), device(1, "llvmpipe", DeviceKind::Software)];
        assert_eq!(chosen(&before[1].itself(), &after), Some(0));
        assert_eq!(chosen(&before[0].itself(), &after), None, "its neighbour is not it");
        assert_eq!(chosen(&before[2].itself(), &after), Some(1));
        // Where drivers say no bus the number is all there is.
        let silent = [at(0, ""), at(1, "")];
        assert_eq!(chosen(&silent[1].itself(), &silent), Some(1));
    }

    #[test]
    fn a_number_is_written_after_gpu_and_all_else_is_a_name() {
        let read = |text: &str| text.parse::<DeviceChoice>().ok();
        assert_eq!(read(" GPU:2"), Some(DeviceChoice::Index(2)));
        assert_eq!(read("Gpu"), Some(DeviceChoice::Auto));
        for name in ["llvmpipe", "GPU 2", "gpus"] {
            assert_eq!(read(name), Some(by_name(name)));
        }
        for wrong in ["", " ", "gpu:", "gpu:x", "gpu:-1", "gpu:1.5"] {
            let error = wrong.parse::<DeviceChoice>().map_err(|error| error.to_string());
            assert!(matches!(&error, Err(why) if why.contains(&format!("`{wrong}`"))), "{error:?}");
        }
    }

    #[test]
    fn what_there_is_is_told() {
        let text = listed(&[device(0, "llvmpipe", DeviceKind::Software)]);
        assert!(text.contains("gpu:0 llvmpipe") && text.contains("software"), "{text}");
        assert!(listed(&[]).contains("driver"));
    }
}
