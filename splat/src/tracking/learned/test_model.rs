//! ONNX files for tests, written byte by byte (onnx.proto, IR version 8, operator set 17).

/// A protobuf message under construction.
#[derive(Clone, Default)]
pub(super) struct Message(Vec<u8>);

impl Message {
    fn varint(&mut self, mut value: u64) {
        while value >= 0x80 {
            self.0.push(value as u8 | 0x80);
            value >>= 7;
        }
        self.0.push(value as u8);
    }

    fn number(mut self, field: u64, value: u64) -> Self {
        self.varint(field << 3);
        self.varint(value);
        self
    }

    fn bytes(mut self, field: u64, value: &[u8]) -> Self {
        self.varint(field << 3 | 2);
        self.varint(value.len() as u64);
        self.0.extend(value);
        self
    }

    fn text(self, field: u64, value: &str) -> Self {
        self.bytes(field, value.as_bytes())
    }

    fn message(self, field: u64, value: Message) -> Self {
        self.bytes(field, &value.0)
    }
}

/// Floating-point tensors, the only kind used here.
const FLOAT: u64 = 1;

/// A network under construction.
#[derive(Clone, Default)]
pub(super) struct Net {
    graph: Message,
    metadata: Vec<(&'static str, &'static str)>,
}

impl Net {
    /// A network of two images; `size` is height and width if they are fixed.
    pub(super) fn of_images(size: Option<[u64; 2]>) -> Self {
        Self::default().input("image1", 3, size).input("image2", 3, size)
    }

    pub(super) fn input(self, name: &str, channels: u64, size: Option<[u64; 2]>) -> Self {
        let side = |index: usize, symbol: &str| match size {
            Some(size) => Message::default().number(1, size[index]),
            None => Message::default().text(2, symbol),
        };
        let fixed = |value| Message::default().number(1, value);
        let shape = [fixed(1), fixed(channels), side(0, "height"), side(1, "width")];
        Self { graph: self.graph.message(11, value_info(name, shape)), ..self }
    }

    pub(super) fn output(self, name: &str) -> Self {
        Self { graph: self.graph.message(12, value_info(name, [])), ..self }
    }

    /// A layer by its operator.
    pub(super) fn node(self, operator: &str, inputs: &[&str], output: &str, ints: &[(&str, &[u64])]) -> Self {
        let mut node = Message::default();
        for input in inputs {
            node = node.text(1, input);
        }
        node = node.text(2, output).text(4, operator);
        for (name, values) in ints {
            // Type 7: a list of integers.
            let attribute = Message::default().text(1, name).number(20, 7);
            node = node
                .message(5, values.iter().fold(attribute, |attribute, &value| attribute.number(8, value)));
        }
        Self { graph: self.graph.message(1, node), ..self }
    }

    pub(super) fn constant(self, name: &str, shape: &[u64], values: &[f32]) -> Self {
        let tensor = shape.iter().fold(Message::default(), |tensor, &extent| tensor.number(1, extent));
        let data: Vec<u8> = values.iter().flat_map(|value| value.to_le_bytes()).collect();
        Self { graph: self.graph.message(5, tensor.number(2, FLOAT).text(8, name).bytes(9, &data)), ..self }
    }

    /// A convolution of one pixel: every output channel from the input's channels and a constant.
    pub(super) fn pointwise(self, input: &str, output: &str, weights: &[&[f32]], biases: &[f32]) -> Self {
        let [kernel, bias] = ["kernel", "bias"].map(|name| format!("{output}.{name}"));
        let shape = [weights.len() as u64, weights[0].len() as u64, 1, 1];
        self.constant(&kernel, &shape, &weights.concat())
            .constant(&bias, &[biases.len() as u64], biases)
            .convolution(&[input, &kernel, &bias], output, 1, 0)
    }

    /// A convolution of `inputs` (image, kernel and possibly bias).
    pub(super) fn convolution(self, inputs: &[&str], output: &str, stride: u64, padding: u64) -> Self {
        let attributes: [(&str, &[u64]); 3] =
            [("strides", &[stride; 2]), ("dilations", &[1; 2]), ("pads", &[padding; 4])];
        self.node("Conv", inputs, output, &attributes)
    }

    /// An entry of the metadata.
    pub(super) fn metadata(mut self, key: &'static str, value: &'static str) -> Self {
        self.metadata.push((key, value));
        self
    }

    /// The file.
    pub(super) fn bytes(self) -> Vec<u8> {
        let operators = Message::default().number(2, 17);
        let mut model =
            Message::default().number(1, 8).message(7, self.graph.text(2, "net")).message(8, operators);
        for (key, value) in self.metadata {
            model = model.message(14, Message::default().text(1, key).text(2, value));
        }
        model.0
    }
}

fn value_info<const N: usize>(name: &str, shape: [Message; N]) -> Message {
    let mut tensor = Message::default().number(1, FLOAT);
    if N > 0 {
        let shape = shape.into_iter().fold(Message::default(), |shape, side| shape.message(1, side));
        tensor = tensor.message(2, shape);
    }
    Message::default().text(1, name).message(2, Message::default().message(1, tensor))
}
